"""The client on its own."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from services import client as face
from services.client import Busy, Client, JobFailed, NotAllowed, NotFound, ServiceError, Unreachable
from services.client._arrays import decode, encode

HEAVY = (
    "httpx2",
    "numpy",
    "OpenEXR",
    "numba",
    "scipy",
    "zarr",
    "dask",
    "distributed",
    "fastapi",
    "sqlalchemy",
)


@pytest.mark.parametrize(
    ("module", "more"),
    [
        ("services.client", {"click", "storage", "workflows"}),
        ("services.cli.main", {"storage.database", "workflows.recovery"}),
    ],
)
def test_importing_it_pulls_in_nothing_heavy(module: str, more: set[str]) -> None:
    script = f"import sys, {module}; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not set(found.stdout.split()) & {*HEAVY, *more}


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
    monkeypatch.setattr("services.client._transport.SILENCE", 0.2)
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
                gone.wait(120)

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


JOB = {
    "id": "j",
    "kind": "recover",
    "state": "running",
    "stage": "recovering",
    "progress": 0.5,
    "tiles": {"total": 2, "done": 1, "failed": 0},
    "eta_seconds": 1.5,
    "waits_for": None,
    "capture": "c",
    "matte": "m",
    "options": {},
    "problem": None,
    "created_at": "2026-01-01T00:00:00Z",
    "finished_at": None,
    "news": "of a later version",
}
Answer = tuple[int, dict[str, str], bytes] | None
"""Status, headers, body; None breaks the connection."""


@contextmanager
def saying(answers: Callable[[int], Answer]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """A web server that answers its n-th call so; its URL, and the calls that came."""
    calls: list[dict[str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def do(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            answer = answers(len(calls))
            calls.append({"call": f"{self.command} {self.path}", "body": body, **self.headers})
            if answer is None:
                self.close_connection = True
                return
            status, headers, content = answer
            self.send_response(status)
            for name, value in ({"Content-Length": str(len(content))} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = do_DELETE = do

        def log_message(self, *arguments: object) -> None:
            pass

    with answering(Handler) as url:
        yield url, calls


def ok(answer: dict[str, Any] = JOB) -> Answer:
    return 200, {"Content-Type": "application/json"}, json.dumps(answer).encode()


def refused(status: int, **headers: str) -> Answer:
    problem = {"type": "urn:x", "title": "t", "status": status, "detail": "why, and what to do", "field": "f"}
    return status, {"Content-Type": "application/problem+json"} | headers, json.dumps(problem).encode()


CALLS: dict[str, Callable[[Client], object]] = {
    "job": lambda client: client.job("j"),
    "recover": lambda client: client.recover("c", quality="fast"),
    "cancel": lambda client: client.cancel("j"),
    "composite": lambda client: client.composite("m", b"backdrop"),
    "layer": lambda client: client.layer("m", "S.png"),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_what_is_safe_is_asked_again_with_the_same_key(call: Callable[[Client], object]) -> None:
    away = {1: None, 2: refused(503), 3: refused(502)}
    with saying(lambda n: away.get(n, ok())) as (url, calls), Client(url) as client:
        client.job("j")  # so that it is known to be there
        call(client)
    assert len(calls) == 5
    assert all(one == calls[1] for one in calls[2:])


def test_a_new_call_has_a_new_key() -> None:
    with saying(lambda n: ok()) as (url, calls), Client(url) as client:
        client.recover("c")
        client.recover("c")
    assert len({call["Idempotency-Key"] for call in calls}) == 2


def test_what_is_not_safe_is_not_asked_again() -> None:
    with saying(lambda n: ok() if n == 0 else None) as (url, calls), Client(url) as client:
        client.job("j")
        with pytest.raises(Unreachable):
            client._http.json("POST", "/v1/jobs/j/retry")
    assert len(calls) == 2


@pytest.mark.parametrize("status", [429, 503])
@pytest.mark.parametrize("after", ["1", "date"])
def test_retry_after_is_waited_for(status: int, after: str) -> None:
    def answer(n: int) -> Answer:
        header = formatdate(time.time() + 2, usegmt=True) if after == "date" else after
        return refused(status, **{"Retry-After": header}) if n == 0 else ok()

    begun = time.monotonic()
    with saying(answer) as (url, calls), Client(url) as client:
        assert client.recover("c").id == "j"
    assert len(calls) == 2
    assert time.monotonic() - begun >= 1  # a date has whole seconds


def test_one_who_is_to_come_much_later_is_told_at_once() -> None:
    with (
        saying(lambda n: refused(429, **{"Retry-After": "3600"})) as (url, calls),
        Client(url) as client,
        pytest.raises(Busy) as caught,
    ):
        client.job("j")
    assert (len(calls), caught.value.retry_after, caught.value.status) == (1, 3600, 429)


@pytest.mark.parametrize(
    ("status", "kind"), [(401, NotAllowed), (403, NotAllowed), (404, NotFound), (422, ServiceError)]
)
def test_an_error_carries_the_problem(status: int, kind: type[ServiceError]) -> None:
    with (
        saying(lambda n: refused(status)) as (url, calls),
        Client(url) as client,
        pytest.raises(ServiceError, match="why, and what to do") as caught,
    ):
        client.recover("c")
    assert type(caught.value) is kind
    assert (caught.value.status, caught.value.problem["field"], len(calls)) == (status, "f", 1)


def test_the_tree_is_drawn_as_it_is() -> None:
    kinds = [getattr(face, name) for name in face.__all__]
    names = [kind.__name__ for kind in kinds if issubclass(kind, Exception)]
    assert face.__doc__ is not None
    drawn = [line.split()[1] for line in face.__doc__.splitlines() if line.strip().startswith(("├", "└"))]
    assert sorted([*drawn, "ServiceError"]) == sorted(names)
    assert all(getattr(face, name).__bases__ == (ServiceError,) for name in drawn)


def test_another_server_is_recognised() -> None:
    with (
        saying(lambda n: (200, {"Content-Type": "text/html"}, b"<html>")) as (url, _),
        Client(url) as client,
        pytest.raises(ServiceError, match="does not answer like an envmatte service"),
    ):
        client.job("j")


@pytest.mark.parametrize("url", ["localhost:8000", "ftp://x", "http://", ""])
def test_invalid_url_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="http://HOST:PORT"):
        Client(url)


def test_waiting_tells_how_far_it_is_and_how_it_ended() -> None:
    states = [{}, {"progress": 0.75}, {"state": "succeeded", "progress": 1.0}]
    seen: list[float] = []
    with saying(lambda n: ok(JOB | states[n])) as (url, _), Client(url) as client:
        done = client.wait("j", progress=lambda job: seen.append(job.progress), poll=0.01)
    assert (seen, done.ended, done["news"]) == ([0.5, 0.75, 1.0], True, "of a later version")
    problem = {"title": "t", "status": 500, "detail": "tile 3 failed"}
    with (
        saying(lambda n: ok(JOB | {"state": "failed", "problem": problem})) as (url, _),
        Client(url) as client,
        pytest.raises(JobFailed, match="tile 3 failed") as caught,
    ):
        client.wait("j")
    assert caught.value.job.id == "j"


def test_a_delete_that_had_come_through_is_none_that_failed() -> None:
    with saying(lambda n: (ok(), None, refused(404), refused(404))[n]) as (url, calls), Client(url) as client:
        job = client.job("j")
        client.delete(job)
        with pytest.raises(NotFound):
            client.delete(job)
    assert [call["call"] for call in calls[1:]] == ["DELETE /v1/jobs/j"] * 3


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 1), (3, 5, 3)])
def test_arrays_survive_the_way(shape: tuple[int, ...], tmp_path: Path) -> None:
    light = np.random.default_rng(1).normal(0, 4, shape).astype(np.float32)
    expected = np.broadcast_to(light.reshape(3, 5, -1), (3, 5, 3))
    np.testing.assert_array_equal(decode(encode(light)), expected)
    (tmp_path / "light.exr").write_bytes(encode(light))
    with OpenEXR.File(str(tmp_path / "light.exr")) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, expected)


@pytest.mark.parametrize(
    ("light", "said"),
    [
        (np.zeros((3, 5), np.uint8), "uint8"),
        (np.zeros((3, 5, 4), np.float32), "not .3, 5, 4"),
        (np.zeros((0, 5), np.float32), "not .0, 5"),
        (np.zeros(5, np.float32), "not .5,"),
    ],
)
def test_what_is_no_backdrop_is_refused(light: np.ndarray, said: str) -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(ValueError, match=said):
        client.composite("m", light)


def test_it_is_marked_as_typed() -> None:
    assert Path(face.__file__).parents[1].joinpath("py.typed").is_file()
