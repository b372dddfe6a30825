"""Clients that read slowly or never, or stop in the middle of a body, on a real port."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path

import httpx2
import psutil
import pytest
import uvicorn
from fastapi import FastAPI

from services.api.app import build_app
from services.api.http import slow_clients
from services.api.http.slow_clients import Connection
from services.settings import Settings
from storage.database.engine import open_engine
from storage.objects.store import Objects
from tests.parts.waiting import until
from tests.services.api.mattes.archives import archive

CHECK_SECONDS = 1.0
SIZE = 560, 400
"""Of a matte whose layers have about 2.7 MB."""
SEND_BUFFER = 1 << 16
"""Of the server's sockets, in bytes, so that a layer does not fit in it."""


@dataclass
class Served:
    """An API without a coordinator, served by this process."""

    app: FastAPI
    server: uvicorn.Server
    port: int
    matte: str
    folder: Path

    @property
    def count(self) -> int:
        """Number of open connections."""
        return len(self.server.server_state.connections)

    def ask(self, path: str) -> httpx2.Response:
        return httpx2.get(f"http://127.0.0.1:{self.port}{path}", timeout=60)

    @contextlib.contextmanager
    def connected(self, sent: bytes, room: int = 1 << 14) -> Iterator[socket.socket]:
        """A connection with a small receive buffer that has sent something."""
        with socket.socket() as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
            connection.settimeout(60)
            connection.connect(("127.0.0.1", self.port))
            connection.sendall(sent)
            yield connection


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    settings = Settings(data=folder)
    engine = open_engine(settings.database_url)
    app = build_app(settings, engine, Objects(settings.store_url))
    config = uvicorn.Config(app, port=0, http=Connection, log_config=None, lifespan="off")
    with pytest.MonkeyPatch.context() as patch, config.bind_socket() as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        bound.listen()  # the server does so only when it has started
        patch.setattr(slow_clients, "CHECK_SECONDS", CHECK_SECONDS)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        port = bound.getsockname()[1]
        sent = httpx2.post(
            f"http://127.0.0.1:{port}/v1/mattes",
            content=archive(folder / "other", *SIZE),
            headers={"Content-Type": "application/zip"},
            timeout=60,
        )
        assert sent.status_code == 201, sent.text
        yield Served(app, server, port, sent.json()["id"], folder)
        server.should_exit = True
        thread.join()
    app.state.context.decoders.close()
    engine.dispose()


def get(path: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()


def rest(connection: socket.socket) -> bytes:
    """Everything that comes until the server closes the connection."""
    received = b""
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(1 << 16):
            received += part
    return received


@pytest.mark.slow
def test_answers_that_nobody_takes_are_held_on_disk_and_given_up(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = f"/v1/mattes/{served.matte}/layers/S.exr"
    whole = served.ask(path)
    assert whole.status_code == 200
    assert whole.headers["content-length"] == str(len(whole.content))
    assert len(whole.content) > 2_000_000
    # Long enough for all connections to be open at once.
    monkeypatch.setattr(slow_clients, "CHECK_SECONDS", 30.0)
    process, count = psutil.Process(), 12
    before = process.memory_info().rss
    with contextlib.ExitStack() as stack:
        connections = [stack.enter_context(served.connected(get(path))) for _ in range(count)]
        for one in connections:
            assert one.recv(12) == b"HTTP/1.1 200"
        grown = process.memory_info().rss - before
        assert grown < count * len(whole.content) // 2, grown
        assert served.ask(path).content == whole.content
    until(lambda: served.count == 0)
    monkeypatch.setattr(slow_clients, "CHECK_SECONDS", CHECK_SECONDS)
    with served.connected(get(path)) as one:
        until(lambda: served.count == 1)
        until(lambda: served.count == 0)
        assert len(rest(one)) < len(whole.content) // 2


def test_answers_that_nobody_takes_keep_their_owner_waiting(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = f"/v1/mattes/{served.matte}/layers/S.exr"
    size = len(served.ask(path).content)
    monkeypatch.setattr(served.app.state.context.shares.answers, "each", 3 * size // 2)
    monkeypatch.setattr(slow_clients, "CHECK_SECONDS", 30.0)
    with contextlib.ExitStack() as stack, served.connected(b"") as last:
        connections = [stack.enter_context(served.connected(get(path))) for _ in range(6)]
        begun = sorted(one.recv(12) for one in connections)
        assert begun == 2 * [b"HTTP/1.1 200"] + 4 * [b"HTTP/1.1 429"]
        last.sendall(get(path))
        last.settimeout(0.5)
        with pytest.raises(TimeoutError):
            last.recv(1)
        stack.close()
        last.settimeout(60)
        assert last.recv(12) == b"HTTP/1.1 200"


@pytest.mark.slow
def test_client_that_reads_single_bytes_is_disconnected(served: Served) -> None:
    with served.connected(get(f"/v1/mattes/{served.matte}/layers/S.exr")) as one:
        until(lambda: one.recv(1) and served.count == 0)


@pytest.mark.slow
def test_slow_client_that_keeps_reading_gets_the_whole_answer(served: Served) -> None:
    path = f"/v1/mattes/{served.matte}/archive"
    sent = get(path).replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
    size = int(served.ask(path).headers["content-length"])
    started = time.monotonic()
    with served.connected(sent) as one:
        received = 0
        while part := one.recv(1 << 16):
            received += len(part)
            time.sleep(0.04)
    assert received > size
    assert time.monotonic() - started > 2 * CHECK_SECONDS


def test_half_closed_connection_that_reads_nothing_is_closed(served: Served) -> None:
    with served.connected(get(f"/v1/mattes/{served.matte}/archive")) as one:
        assert one.recv(12) == b"HTTP/1.1 200"
        one.shutdown(socket.SHUT_WR)
        until(lambda: served.count == 0)


def head(method: str, path: str, **headers: str) -> bytes:
    lines = [f"{method} {path} HTTP/1.1", "Host: localhost", "Content-Length: 1000000"]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return "\r\n".join([*lines, "", ""]).encode()


@pytest.mark.parametrize("trickle", [b"", b"x"], ids=["silent", "single bytes"])
@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/v1/captures", "application/zip"),
        pytest.param("/v1/mattes", "application/zip", marks=pytest.mark.slow),
        pytest.param("/v1/jobs", "application/json", marks=pytest.mark.slow),
        pytest.param("/v1/mattes/MATTE/composite", "image/png", marks=pytest.mark.slow),
        ("/v1/mattes/MATTE/composite", "video/mp4"),
    ],
)
def test_client_that_stops_sending_its_body_is_disconnected(
    served: Served, path: str, kind: str, trickle: bytes
) -> None:
    before = files(served)
    sent = head("POST", path.replace("MATTE", served.matte), Content_Type=kind) + b"{" * 2000
    with served.connected(sent) as one:
        until(lambda: served.count == 1)
        with contextlib.suppress(ConnectionError):
            while served.count:
                one.sendall(trickle)
                time.sleep(0.1)
        assert rest(one) == b""
    until(lambda: files(served) == before)


@pytest.mark.slow
def test_connection_stays_open_longer_than_clients_keep_it(served: Served) -> None:
    with contextlib.closing(HTTPConnection("127.0.0.1", served.port, timeout=60)) as connection:
        connection.connect()
        begun = connection.sock
        for wait in (6, 0):  # httpx keeps one for 5
            connection.request("GET", "/healthz")
            assert connection.getresponse().read()
            assert connection.sock is begun
            time.sleep(wait)


@pytest.mark.slow
def test_trickling_client_is_disconnected(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slow_clients, "CHECK_SECONDS", 4.0)
    with served.connected(head("POST", "/v1/captures", Content_Type="application/zip")) as one:
        until(lambda: served.count == 1)
        with contextlib.suppress(ConnectionError):
            while served.count:
                one.sendall(bytes(50))  # 500 bytes a second
                time.sleep(0.1)
        assert rest(one) == b""


def test_upload_keeps_the_bytes_that_came_before_the_disconnect(served: Served) -> None:
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "1000000"}
    where = httpx2.post(f"http://127.0.0.1:{served.port}/v1/uploads", headers=tus).headers["location"]
    kind = {"Content_Type": "application/offset+octet-stream", "Upload_Offset": "0", "Tus_Resumable": "1.0.0"}
    with served.connected(head("PATCH", where, **kind) + b"a" * 3000) as one:
        assert rest(one) == b""

    def offset() -> str:
        url = f"http://127.0.0.1:{served.port}{where}"
        return httpx2.head(url, headers={"Tus-Resumable": "1.0.0"}).headers["upload-offset"]

    until(lambda: offset() == "3000")


@pytest.mark.slow
def test_slow_client_that_keeps_sending_is_served(served: Served) -> None:
    size = 1_000_000
    sent = head("POST", f"/v1/mattes/{served.matte}/composite", Connection="close")
    started = time.monotonic()
    with served.connected(sent) as one:
        for _ in range(50):
            one.sendall(bytes(size // 50))
            time.sleep(0.06)
        assert rest(one).startswith(b"HTTP/1.1 422")
    assert time.monotonic() - started > 2 * CHECK_SECONDS


@pytest.mark.slow
def test_stream_without_events_stays_open(served: Served) -> None:
    program = httpx2.post(f"http://127.0.0.1:{served.port}/v1/programs", json={"preset": "sketch"}).json()
    with served.connected(get(f"/v1/programs/{program['id']}/events")) as one:
        assert one.recv(12) == b"HTTP/1.1 200"
        time.sleep(4 * CHECK_SECONDS)
        assert served.count == 1


def files(served: Served) -> set[Path]:
    return {path for path in (served.folder / "store").rglob("*") if path.is_file()}
