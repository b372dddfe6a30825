"""An upload over a bad line: to a web server that takes no large request."""

import os
from functools import partial
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from types import SimpleNamespace

import pytest

from services.client import Client, ServiceError, _upload
from services.client._session import PATIENCE, Session
from tests.services.client.servers import scripted_server, web_server

MOST = 64 << 10
"""Bytes of a request that come through."""


def test_requests_get_smaller_until_they_come_through_and_larger_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    come = bytearray()
    sizes: list[int] = []

    class Line(BaseHTTPRequestHandler):
        def do(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            status = 200
            if self.command == "PATCH":
                sizes.append(len(body))
                status = 503 if len(body) > MOST else 200
                if status == 200:
                    come.extend(body)
            answer = b'{"id": "u"}' if self.path == "/v1/captures" else b""
            self.send_response(status)
            for name, value in (("Upload-Offset", len(come)), ("Content-Length", len(answer))):
                self.send_header(name, str(value))
            self.send_header("Location", "/v1/uploads/u")
            self.end_headers()
            self.wfile.write(answer)

        do_POST = do_HEAD = do_PATCH = do

        def log_message(self, *arguments: object) -> None:
            pass

    def now() -> float:
        return len(sizes) * PATIENCE / 4  # each request takes so long: all of them far more than the patience

    waits: list[float] = []
    monkeypatch.setattr(_upload, "time", SimpleNamespace(monotonic=now, sleep=waits.append))
    monkeypatch.setattr(_upload, "LARGEST", 4 * MOST)
    monkeypatch.setattr(_upload, "SMALLEST", MOST // 2)
    data = bytes(range(256)) * (5 * MOST // 256)
    (tmp_path / "ball.zip").write_bytes(data)
    with web_server(Line) as url:
        http = Session(url, None)
        assert _upload.send(http, tmp_path / "ball.zip", {}, None) == {"id": "u"}
        http.close()
    assert come == data
    fails, comes = 2 * MOST, MOST
    assert sizes == [2 * fails, fails, *3 * [comes, fails], comes, comes]
    assert waits[1] > waits[0] == waits[2]


def test_only_files_are_sent(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "ball.zip")
    with Client("http://127.0.0.1:9") as client:
        for send in (client.upload, client.import_matte, partial(client.composite_clip, "matte")):
            for path in (pipe, tmp_path):
                with pytest.raises(ValueError, match="is not a file: write what it holds into one"):
                    send(path)


@pytest.mark.parametrize("status", [200, 502])
def test_what_is_no_service_is_asked_once(tmp_path: Path, status: int) -> None:
    answer = status, {"Content-Type": "text/html"}, b"<html>"
    (tmp_path / "ball.zip").write_bytes(b"ball")
    with (
        scripted_server(lambda n: answer) as (url, calls),
        Client(url) as client,
        pytest.raises(ServiceError),
    ):
        client.upload(tmp_path / "ball.zip")
    assert len(calls) == 1


@pytest.mark.parametrize("location", ["/v1/uploads/u", "/glass/v1/uploads/u"])
def test_upload_comes_through_a_proxy_that_serves_below_a_prefix(tmp_path: Path, location: str) -> None:
    come = bytearray()

    class Proxy(BaseHTTPRequestHandler):
        def do(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            below = self.path in ("/glass/v1/uploads", "/glass/v1/uploads/u", "/glass/v1/captures")
            if below and self.command == "PATCH":
                come.extend(body)
            answer = b'{"id": "u"}' if self.path.endswith("captures") else b""
            self.send_response(200 if below else 404)
            for name, value in (
                ("Location", location),
                ("Upload-Offset", len(come)),
                ("Content-Length", len(answer)),
            ):
                self.send_header(name, str(value))
            self.end_headers()
            self.wfile.write(answer)

        do_POST = do_HEAD = do_PATCH = do

        def log_message(self, *arguments: object) -> None:
            pass

    (tmp_path / "ball.zip").write_bytes(b"ball")
    with web_server(Proxy) as url:
        http = Session(f"{url}/glass/", None)
        assert _upload.send(http, tmp_path / "ball.zip", {}, None) == {"id": "u"}
        http.close()
    assert come == b"ball"
