"""The client on its own."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from services.client import Client, ServiceError

HEAVY = (
    "numpy",
    "numba",
    "scipy",
    "zarr",
    "dask",
    "distributed",
    "fastapi",
    "sqlalchemy",
    "workflows",
    "storage",
)


@pytest.mark.parametrize("module", ["services.client", "services.cli"])
def test_importing_it_pulls_in_nothing_heavy(module: str) -> None:
    script = (
        f"import sys, {module}; print(*{{name.partition('.')[0] for name in sys.modules}} & set({HEAVY!r}))"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


def test_a_service_that_is_not_there_is_named() -> None:
    with (
        Client("http://127.0.0.1:9") as client,
        pytest.raises(ServiceError, match=r"127\.0\.0\.1:9.*envmatte serve"),
    ):
        client.job("any")


def test_an_upload_to_a_service_that_is_not_there_ends_at_once(tmp_path: Path) -> None:
    (tmp_path / "any.zip").write_bytes(b"any")
    with Client("http://127.0.0.1:9") as client, pytest.raises(ServiceError, match="envmatte serve"):
        client.upload(tmp_path / "any.zip")


@contextmanager
def answering(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """A web server of its own; its URL."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def test_the_page_of_a_proxy_becomes_an_error() -> None:
    class Proxy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(502)

        def log_message(self, *arguments: object) -> None:
            pass

    with (
        answering(Proxy) as url,
        Client(url) as client,
        pytest.raises(ServiceError, match="502 Bad Gateway") as caught,
    ):
        client.job("any")
    assert caught.value.problem["status"] == 502


def test_what_the_service_computes_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.client.SILENCE", 0.2)
    gone = threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "layers" in self.path:
                gone.wait(
                    30
                )  # until the other request was given up, and so for longer than it was waited for
                self.send_response(200)
                self.end_headers()
                self.wfile.write(b"pixels")
            else:
                gone.wait(30)

        def log_message(self, *arguments: object) -> None:
            pass

    found: list[bytes] = []
    with answering(Slow) as url, Client(url) as patient, Client(url) as client:
        waiting = threading.Thread(target=lambda: found.append(patient.layer("m", "S.png")))
        waiting.start()
        with pytest.raises(ServiceError, match="no answer"):
            client.job("any")
        gone.set()
        waiting.join()
    assert found == [b"pixels"]
