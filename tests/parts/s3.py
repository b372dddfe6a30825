"""moto's S3 server in its own process, with a bucket. It speaks the protocol but is no store to rely on."""

import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest

BUCKET = "envmatte"
SERVER = """
from moto.moto_server.werkzeug_app import create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server

WSGIRequestHandler.log_request = lambda *_: None
server = make_server("127.0.0.1", 0, create_backend_app("s3"), threaded=True)
print(f"http://127.0.0.1:{server.port}", flush=True)
server.serve_forever()
"""
"""Takes half of the processor time of ``moto.server``, which logs each request, and looks for its service in all of
AWS."""
KEYS = {"AWS_ACCESS_KEY_ID": "somebody", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_REGION": "us-east-1"}


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The server's URL."""
    log: Path = tmp_path_factory.mktemp("s3") / "server.log"
    with log.open("wb") as file:
        command = [sys.executable, "-c", SERVER]
        server = subprocess.Popen(command, stdout=file, stderr=file)
    try:
        yield _with_bucket(server, log)
    finally:
        server.kill()
        server.wait()


@pytest.fixture
def s3(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of an empty store, which started processes find too."""
    for name, value in {"AWS_ENDPOINT_URL": s3_server, **KEYS}.items():
        monkeypatch.setenv(name, value)
    return f"s3://{BUCKET}/{uuid.uuid4().hex}"


def _with_bucket(server: "subprocess.Popen[bytes]", log: Path) -> str:
    """Wait until the server prints its address, and make the bucket."""
    end = time.monotonic() + 120
    while True:
        addresses = [word for word in log.read_text().split() if word.startswith("http://127.0.0.1:")]
        if addresses:
            url = addresses[0].rstrip("/")
            signed = {
                "Authorization": "AWS4-HMAC-SHA256 Credential=somebody/20260101/us-east-1/s3/aws4_request"
            }
            try:
                with urlopen(Request(f"{url}/{BUCKET}", method="PUT", headers=signed), timeout=30):
                    return url
            except URLError:
                pass
        assert server.poll() is None, log.read_text()
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.1)
