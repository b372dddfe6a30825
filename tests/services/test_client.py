"""The client on its own."""

import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
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


def test_the_page_of_a_proxy_becomes_an_error() -> None:
    class Proxy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(502)

        def log_message(self, *arguments: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Proxy) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with (
            Client(f"http://127.0.0.1:{server.server_port}") as client,
            pytest.raises(ServiceError, match="502 Bad Gateway") as caught,
        ):
            client.job("any")
        server.shutdown()
        thread.join()
    assert caught.value.problem["status"] == 502
