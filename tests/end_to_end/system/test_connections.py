"""Slow or malicious connections do not keep other clients out."""

import contextlib
import resource
import socket
import statistics
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import psutil
import pytest

from services.api.http import slow_clients
from tests.end_to_end.conftest import Service
from tests.parts.waiting import until
from tests.services.api.http.test_slow_clients import rest


@contextlib.contextmanager
def connected(service: Service, count: int = 1) -> Iterator[list[socket.socket]]:
    url = urlsplit(service.url)
    assert url.hostname is not None
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(socket.create_connection((url.hostname, url.port), timeout=90))
            for _ in range(count)
        ]


@pytest.mark.slow
def test_thousands_of_idle_connections_are_served_around_and_closed(service: Service) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    count = min(10_000, hard - 1000)  # as many in this process as in the service's
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    process = psutil.Process(service.process.pid)
    before, peak = process.num_fds(), 0
    try:
        for _ in range(5):  # a busy machine may still be opening them when the first are closed
            with connected(service, count) as idle:
                times = []
                for _ in range(100):
                    peak = max(peak, process.num_fds() - before)
                    start = time.perf_counter()
                    assert service.http.get("/healthz").status_code == 200
                    times.append(time.perf_counter() - start)
                assert rest(idle[-1]) == b""
            until(lambda: process.num_fds() - before <= 50)
            slowest = 1e3 * statistics.quantiles(times, n=100)[98]
            print(f"{peak} of {count} idle connections held at once: {slowest:.1f} ms at p99")
            if peak > 0.95 * count:
                break
        else:
            pytest.fail(f"of {count} connections {peak} at most were held at once")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.slow
def test_slow_request_head_is_disconnected(service: Service) -> None:
    begun = time.monotonic()
    with connected(service) as (slow,):
        slow.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow.recv(1 << 16).startswith(b"HTTP/1.1 200")
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            while time.monotonic() - begun < 4 * slow_clients.HEAD:
                slow.sendall(b"G")
                time.sleep(0.5)
    assert time.monotonic() - begun < 3 * slow_clients.HEAD


POST = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\n"
SMUGGLED = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
"""A request that is part of another's body for one reader, and one of its own for another (RFC 9112, sect. 11.2)."""


@pytest.mark.parametrize(
    "sent",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\nLong: " + (1 << 20) * b"x",
        b"GET /" + (1 << 20) * b"x" + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"no request at all\r\n\r\n",
        b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n{}   ",
        b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\nTransfer-Encoding: gzip\r\n\r\n{}",
        b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n" + 20_000 * b"Many: x\r\n",
        POST + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + SMUGGLED,
        POST + b"Transfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\n0\r\n\r\n" + SMUGGLED,
        POST + b"Transfer-Encoding : chunked\r\n\r\n0\r\n\r\n" + SMUGGLED,
        POST + b"Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n" + SMUGGLED,
        POST + b"Transfer-Encoding: chunked\r\n\r\n0x0\r\n\r\n" + SMUGGLED,
        POST + b"Content-Length: +0\r\n\r\n" + SMUGGLED,
        POST + b"Content-Length: 0\r\n Content-Length: 9\r\n\r\n" + SMUGGLED,
    ],
    ids=[
        "a long header",
        "a long path",
        "noise",
        "two lengths",
        "an unknown encoding",
        "many headers",
        "length, then chunks",
        "chunks, then length",
        "space before a colon",
        "an encoding like chunks",
        "chunks in hexadecimal notation",
        "a signed length",
        "a folded header",
    ],
)
def test_malformed_request_is_refused_and_disconnected(service: Service, sent: bytes) -> None:
    with connected(service) as (connection,):
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(sent)
        received = rest(connection)
    assert received[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 501")
    assert received.count(b"HTTP/1.1 ") <= 1  # what is behind a request that is refused is none
    assert service.http.get("/healthz").status_code == 200


def test_half_closed_connection_is_closed(service: Service) -> None:
    """Until it is written to it looks like a closed one, and an answer that no client reads would cost more."""
    for sent in (b"GET /v1/jobs HTTP/1.1\r\nHost: localhost\r\n\r\n", b"GET /healthz HT"):
        with connected(service) as (half,):
            half.sendall(sent)
            half.shutdown(socket.SHUT_WR)
            assert rest(half)[:12] in (b"", b"HTTP/1.1 200", b"HTTP/1.1 400")
    assert service.http.get("/healthz").status_code == 200
