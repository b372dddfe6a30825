"""Errors as answers: headers that a status needs besides the problem detail."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi import FastAPI, Request
from fastapi.testclient import TestClient
from pydantic import BaseModel

from services.api.http.bodies import read_json
from services.api.http.errors import register
from services.api.mattes.composites.params import CompositeParams
from services.api.mattes.links import LinkRequest
from services.api.programs.programs import PlaybackState, ProgramRequest
from services.runtime.problems import Unauthorized
from storage.errors import Corrupt, EnvmatteError, NotFound, Unavailable
from storage.objects import marker
from storage.objects.store import Objects

UNEXPECTED = """
import threading, time, httpx2, uvicorn
from fastapi import FastAPI
from services.api.http.errors import register
from services.runtime.logs import configure_logging

app = FastAPI()
register(app)

@app.get("/")
def fail() -> None:
    raise ValueError("a bug")

configure_logging("text", "INFO", "test")
server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None, log_level="warning", lifespan="off"))
thread = threading.Thread(target=server.run)
thread.start()
while not server.started:
    time.sleep(0.01)
port = server.servers[0].sockets[0].getsockname()[1]
assert httpx2.get(f"http://127.0.0.1:{port}/").status_code == 500
server.should_exit = True
thread.join()
"""


@pytest.mark.parametrize(
    ("error", "status", "header"),
    [
        (Unavailable("the database can't be reached"), 503, ("retry-after", "2")),
        (Unauthorized("a key is needed"), 401, ("www-authenticate", "Bearer")),
        (NotFound("there is none"), 404, None),
    ],
)
def test_error_is_answered_with_the_header_of_its_status(
    error: EnvmatteError, status: int, header: tuple[str, str] | None
) -> None:
    app = FastAPI()
    register(app)

    @app.get("/")
    def fail() -> None:
        raise error

    with TestClient(app) as client:
        response = client.get("/")
    assert (response.status_code, response.json()["detail"]) == (status, error.detail)
    extra = set(response.headers.items()) - {("content-type", "application/problem+json")}
    assert {(name, value) for name, value in extra if name != "content-length"} == (
        {header} if header else set()
    )


def test_share_that_hangs_holds_up_no_other_request(tmp_path: Path) -> None:
    app = FastAPI()
    register(app)
    objects = Objects((tmp_path / "store").as_uri())
    objects.installation = "an-id"
    os.mkfifo(tmp_path / "store" / marker.PATH)  # reading it waits for a writer
    app.state.context = SimpleNamespace(objects=objects)

    @app.get("/damaged")
    def fail() -> None:
        raise Corrupt("it is damaged")

    @app.get("/alive")
    async def alive() -> str:
        return "alive"

    with TestClient(app) as client, ThreadPoolExecutor(2) as pool:
        damaged = pool.submit(client.get, "/damaged")
        try:
            time.sleep(0.5)
            assert pool.submit(client.get, "/alive").result(timeout=5).json() == "alive"
            assert not damaged.done()
        finally:
            with (tmp_path / "store" / marker.PATH).open(
                "wb"
            ):  # the reader may be gone before anything is written
                pass
        assert damaged.result().status_code == 503


@pytest.mark.parametrize(
    ("response", "parts", "detail"),
    [
        ('{"gamma": 1e-300}', "[]", "program.monitor.response.gamma: must be at least 0.2"),
        ('{"gamma": NaN}', "[]", "program.monitor.response.gamma: must be a number"),
        (
            '"film"',
            "[]",
            "program.monitor.response: must be 'linear', 'srgb' or 'unknown'",
        ),
        (
            '"srgb"',
            '[{"kind": "constant", "levels": [0, 2]}]',
            "program.parts.0.levels.1: must be at most 1.0",
        ),
    ],
)
def test_field_of_a_body_is_named_as_its_sender_does(response: str, parts: str, detail: str) -> None:
    app = FastAPI()
    register(app)

    @app.post("/")
    async def read(request: Request) -> None:
        await read_json(request, ProgramRequest, 1000)

    monitor = f'{{"width": 64, "height": 48, "response": {response}}}'
    with TestClient(app) as client:
        answer = client.post("/", content=f'{{"program": {{"monitor": {monitor}, "parts": {parts}}}}}')
    assert (answer.status_code, answer.json()["detail"]) == (422, detail)
    assert answer.json()["field"] == detail.partition(":")[0]


@pytest.mark.parametrize(
    ("model", "given", "field"),
    [
        (CompositeParams, "", "right"),
        (LinkRequest, "", "days"),
        (PlaybackState, '"phase": "shown", ', "patterns_per_second"),
    ],
)
def test_what_is_not_a_number_is_refused_as_such(model: type[BaseModel], given: str, field: str) -> None:
    app = FastAPI()
    register(app)

    @app.post("/")
    async def read(request: Request) -> None:
        await read_json(request, model, 1000)

    with TestClient(app) as client:
        answer = client.post("/", content=f'{{{given}"{field}": NaN}}')
    assert answer.json()["detail"] == f"{field}: must be a number"


def test_unexpected_error_announces_that_the_connection_is_closed() -> None:
    app = FastAPI()
    register(app)

    @app.get("/")
    def fail() -> None:
        raise ValueError

    with TestClient(app, raise_server_exceptions=False) as client:
        answer = client.get("/")
    assert (answer.status_code, answer.headers["connection"]) == (500, "close")


def test_unexpected_error_is_logged_once() -> None:
    done = subprocess.run([sys.executable, "-c", UNEXPECTED], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "ERROR services.api.http.errors GET /" in done.stderr
    assert done.stderr.count("ValueError: a bug") == 1
