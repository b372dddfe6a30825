"""The object store answers with 503, late or not at all: jobs wait and continue."""

import http.client
import random
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.faults.conftest import Prepared, check, prepare
from tests.parts.rig import Rig, Row
from tests.parts.s3 import BUCKET, KEYS
from tests.parts.waiting import until

pytestmark = [pytest.mark.timeout(3600), pytest.mark.exhaustive]

AWAY = 10.0
"""Seconds for which the store is away."""
SHARE = 0.2
"""Share of requests that fail."""


class Proxy(ThreadingHTTPServer):
    """A proxy in front of a bucket that forwards requests or fails them as configured."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, server: str) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.server = urlsplit(server).netloc
        self.refused = 0.0
        """Share of requests that are answered with 503."""
        self.silent = 0.0
        """Share of requests whose connection is closed after some seconds without an answer."""
        self.lost = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that left before their answer."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Proxy

    def _forward(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        fate = random.random()
        if fate < self.server.refused:
            self.server.lost += 1
            self._answer(503, {}, b"")
            return
        if fate < self.server.refused + self.server.silent:
            self.server.lost += 1
            self.close_connection = True
            time.sleep(3)
            return
        upstream = http.client.HTTPConnection(self.server.server, timeout=30)
        upstream.request(self.command, self.path, body, dict(self.headers))
        answer = upstream.getresponse()
        self._answer(answer.status, dict(answer.getheaders()), answer.read())
        upstream.close()

    def _answer(self, status: int, headers: dict[str, str], body: bytes) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            if name.lower() not in ("transfer-encoding", "connection", "content-length"):
                self.send_header(name, value)
        length = headers.get("Content-Length", len(body)) if self.command == "HEAD" else len(body)
        self.send_header("Content-Length", str(length))
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = _forward

    def log_message(self, format: str, *arguments: object) -> None:
        """Log nothing."""


@pytest.fixture(scope="module")
def proxy(s3_server: str) -> Iterator[Proxy]:
    with Proxy(s3_server) as proxy:
        thread = threading.Thread(target=proxy.serve_forever)
        thread.start()
        yield proxy
        proxy.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def in_bucket(
    s3_server: str, proxy: Proxy, tmp_path_factory: pytest.TempPathFactory, capture_archive: Path
) -> Iterator[Prepared]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"AWS_ENDPOINT_URL": s3_server, **KEYS}.items():
            patch.setenv(name, value)  # the test itself bypasses the proxy
        through = {"AWS_ENDPOINT_URL": proxy.url, "ENVMATTE_ATTEMPTS": "1"}
        with Rig(tmp_path_factory.mktemp("bucket"), store=f"s3://{BUCKET}/faults", **through) as rig:
            yield prepare(rig, capture_archive)


def test_store_answers_503_at_times(
    in_bucket: Prepared, proxy: Proxy, table: list[Row], fewer_times: int
) -> None:
    proxy.refused, before = SHARE, proxy.lost
    row = in_bucket.disturb("503 from the store, of one in 5", lambda: None, fewer_times)
    proxy.refused = 0
    assert proxy.lost > before
    check(table, row)


def test_store_does_not_answer_at_times(
    in_bucket: Prepared, proxy: Proxy, table: list[Row], fewer_times: int
) -> None:
    def act() -> None:
        proxy.silent = SHARE
        time.sleep(5)
        proxy.silent = 0

    row = in_bucket.disturb("no answer from the store, of one in 5", act, fewer_times)
    check(table, row)


def test_store_away_for_a_while(
    in_bucket: Prepared, proxy: Proxy, table: list[Row], fewer_times: int
) -> None:
    def act() -> None:
        proxy.refused = 1
        time.sleep(AWAY)
        proxy.refused = 0

    check(table, in_bucket.disturb("503 from the store, for 10 s", act, fewer_times))


def test_store_that_stays_away(in_bucket: Prepared, proxy: Proxy, table: list[Row]) -> None:
    """A job under way and one that is queued meanwhile wait, say so, and continue."""
    rig = in_bucket.rig
    recoveries = [rig.recover(in_bucket.capture)]
    while rig.job(recoveries[0]["id"])["progress"] < 0.2:
        time.sleep(0.05)
    proxy.refused = 1
    recoveries.append(rig.recover(in_bucket.capture))
    for job in recoveries:
        until(lambda job=job: "cannot reach the store" in (rig.job(job["id"])["waits_for"] or ""), 300)
        log = rig.ask("GET", f"/v1/jobs/{job['id']}/log").json()
        assert "waiting for the store" in log["lines"][-1]["text"]
    start = time.monotonic()
    proxy.refused = 0
    row = Row("a store that stays away", 1)
    for job in recoveries:
        row.lost += rig.ended(job["id"])["state"] != "succeeded"
        row.seconds.append(round(time.monotonic() - start, 2))
        row.differing += rig.files(job["matte"]) != in_bucket.files
    check(table, row)
