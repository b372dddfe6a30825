"""Every route of a real service with every kind of key."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import envmatte
import httpx2
import numpy as np
import pytest

from services.client import Client, NotAllowed, NotFound
from storage.database.engine import open_engine, writing
from storage.records import api_keys
from tests.end_to_end.conftest import Service, paused, png, serving
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until

pytestmark = pytest.mark.slow

HEADERS = {
    "content-security-policy",
    "cross-origin-resource-policy",
    "referrer-policy",
    "x-content-type-options",
}
"""Headers that every response has."""
TUS = {"Tus-Resumable": "1.0.0"}
ZIP = {"Content-Type": "application/zip"}
SCOPES = {"read": "read", "write": "write", "admin": "admin", "other": "write", "other's admin": "admin"}
"""Scopes of the valid keys. The other's keys belong to bob, the rest to alice."""
CONFIGURED = ("first-key", "second-key")
"""Keys from the service's settings."""
KINDS = ("none", "wrong", "revoked", *SCOPES)


@dataclass(frozen=True)
class Call:
    """How a route is called, and with which of alice's ids."""

    id: str | None = None
    headers: dict[str, str] | None = None
    json: dict[str, Any] | None = None
    content: bytes | None = None
    needs: str = "read"
    """The scope it needs; empty if it needs no key."""
    named: bool = False
    """Whether it names something of alice's outside of the path."""
    last: int = 0
    """Not 0 if it deletes something: permitted calls come after all others, in this order."""


CALLS = {
    "GET /healthz": Call(needs=""),
    "GET /readyz": Call(needs=""),
    "GET /metrics": Call(needs="admin"),
    "GET /v1/cluster": Call(needs="admin"),
    "GET /v1/limits": Call(),
    "GET /v1/options": Call(),
    "GET /v1/presets": Call(),
    "OPTIONS /v1/uploads": Call(),
    "POST /v1/uploads": Call(needs="write", headers=TUS | {"Upload-Length": "5"}),
    "HEAD /v1/uploads/{id}": Call("upload", headers=TUS),
    "PATCH /v1/uploads/{id}": Call(
        "upload",
        needs="write",
        headers=TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"},
        content=b"12",
    ),
    "DELETE /v1/uploads/{id}": Call("upload", needs="write", headers=TUS, last=1),
    "GET /v1/capture.schema.json": Call(),
    "GET /v1/captures": Call(),
    "POST /v1/captures": Call(needs="write", json={"upload": "{upload}"}, named=True),
    "GET /v1/captures/{id}": Call("capture"),
    "PATCH /v1/captures/{id}": Call("capture", needs="write", json={"name": "a name"}),
    "GET /v1/captures/{id}/frames/{n}.png": Call("capture"),
    "GET /v1/captures/{id}/report": Call("capture"),
    "GET /v1/captures/{id}/thumbnail.png": Call("capture"),
    "GET /v1/captures/{id}/contact-sheet.png": Call("capture"),
    "DELETE /v1/captures/{id}": Call("capture", needs="write", last=5),
    "GET /v1/jobs": Call(),
    "POST /v1/jobs": Call(needs="write", json={"capture": "{capture}"}, named=True, last=4),
    "GET /v1/jobs/{id}": Call("job"),
    "GET /v1/jobs/{id}/log": Call("job"),
    "GET /v1/jobs/{id}/events": Call("job"),
    "GET /v1/jobs/{id}/video.mp4": Call("job"),
    "PATCH /v1/jobs/{id}": Call("job", needs="write", json={"paused": True}),
    "POST /v1/jobs/{id}/cancel": Call("job", needs="write"),
    "POST /v1/jobs/{id}/retry": Call("job", needs="write"),
    "DELETE /v1/jobs/{id}": Call("job", needs="write", last=3),
    "GET /v1/mattes": Call(),
    "POST /v1/mattes": Call(needs="write", headers=ZIP, content=b"no archive"),
    "GET /v1/mattes/{id}": Call("matte"),
    "PATCH /v1/mattes/{id}": Call("matte", needs="write", json={"name": "a name"}),
    "GET /v1/mattes/{id}/archive": Call("matte"),
    "GET /v1/mattes/{id}/zarr/{entry}": Call("matte"),
    "GET /v1/mattes/{id}/layers/{file}": Call("matte"),
    "GET /v1/mattes/{id}/live": Call("matte"),
    "GET /v1/mattes/{id}/live.html": Call("matte"),
    "GET /v1/mattes/{id}/transport": Call("matte"),
    "GET /v1/mattes/{id}/transport.png": Call("matte"),
    "GET /v1/mattes/{id}/links": Call("matte"),
    "POST /v1/mattes/{id}/links": Call("matte", needs="write", json={"days": 1}),
    "DELETE /v1/mattes/{id}/links/{link}": Call("matte", needs="write", last=1),
    "GET /share/{token}": Call(needs=""),
    "GET /v1/qr.svg": Call(needs=""),
    "GET /embed/{token}": Call(needs=""),
    "POST /v1/mattes/{id}/composite": Call(
        "matte", needs="write", content=png(np.full((9, 12, 3), 0.5), "srgb", np.uint8)
    ),
    "DELETE /v1/mattes/{id}": Call("matte", needs="write", last=2),
    "GET /v1/programs": Call(),
    "POST /v1/programs": Call(needs="write", json={"preset": "quick"}),
    "GET /v1/programs/{id}": Call("program"),
    "GET /v1/programs/{id}/program.json": Call("program"),
    "GET /v1/programs/{id}/patterns/{n}.png": Call("program"),
    "GET /v1/programs/{id}/patterns.zip": Call("program"),
    "GET /v1/programs/{id}/patterns.mp4": Call("program"),
    "GET /v1/programs/{id}/play": Call("program", needs=""),
    "GET /v1/programs/{id}/events": Call("program"),
    "PUT /v1/programs/{id}/showing": Call(
        "program", needs="write", json={"phase": "shown", "patterns_per_second": 2}
    ),
    "GET /v1/network": Call(),
    "DELETE /v1/programs/{id}": Call("program", needs="write", last=1),
}


@dataclass
class Locked:
    """A service with keys, and alice's data there."""

    service: Service
    keys: dict[str, str]
    ids: dict[str, str]

    def call(self, route: str, key: str | None) -> httpx2.Response:
        method, path = route.split(" ")
        call = CALLS[route]
        for name, value in (
            ("id", self.ids.get(call.id or "")),
            ("n", "0"),
            ("file", "S.png"),
            ("entry", "zarr.json"),
            ("link", self.ids["link"]),
            ("token", self.ids["token"]),
        ):
            path = path.replace(f"{{{name}}}", value or "")
        body = json.dumps(call.json or {})
        for name, value in self.ids.items():
            body = body.replace(f"{{{name}}}", value)
        with self.service.http.stream(
            method,
            f"{path}?x=0&y=0" if "transport" in path else path,
            headers=(call.headers or {}) | bearer(key),
            content=call.content,
            json=json.loads(body) if call.json else None,
        ) as answer:
            if not (answer.is_success and path.endswith("/events")):  # streams that may never end
                answer.read()
            return answer


def bearer(key: str | None) -> dict[str, str]:
    return {} if key is None else {"Authorization": f"Bearer {key}"}


def command(data: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "services", "keys", *arguments, "--data", str(data)]
    environment = {name: value for name, value in os.environ.items() if name != "ENVMATTE_KEYS"}
    return subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment)


@pytest.fixture(scope="module")
def locked(capture_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Locked]:
    data = tmp_path_factory.mktemp("locked") / "data"
    data.mkdir()
    made: dict[str, str] = {"wrong": "envmatte_" + 43 * "x"}
    engine = open_engine(f"sqlite:///{data}/envmatte.db")
    with writing(engine) as c:
        for kind, scope in (*SCOPES.items(), ("revoked", "admin")):
            made[kind] = api_keys.create(c, kind, "bob" if kind.startswith("other") else "alice", scope)
        api_keys.revoke(c, "revoked")
    engine.dispose()
    settings = {"ENVMATTE_KEYS": ", ".join(CONFIGURED), "ENVMATTE_LOG_LEVEL": "DEBUG"}
    with serving(data, **settings) as service, Client(service.url, made["write"]) as alice:
        capture = alice.upload(capture_archive)
        alice.wait(capture["job"])
        job = alice.wait(alice.recover(capture["id"])["id"])
        body = {"preset": "quick", "monitor": {"width": 64, "height": 48}}
        program = service.http.post("/v1/programs", json=body, headers=bearer(made["write"])).json()["id"]
        create = TUS | {"Upload-Length": "9"} | bearer(made["write"])
        upload = service.http.post("/v1/uploads", headers=create).headers["location"].rsplit("/", 1)[1]
        made_link = alice.share(job["matte"])
        listed = service.http.get(f"/v1/mattes/{job['matte']}/links", headers=bearer(made["write"])).json()
        link = {"link": listed["links"][0]["id"], "token": made_link.rpartition("/")[2]}
        ids = link | {"capture": capture["id"], "job": job["id"], "matte": job["matte"], "program": program}
        yield Locked(service, made, ids | {"upload": upload})


def expected(route: str, kind: str) -> int | None:
    """The status of a refusal, or None."""
    call = CALLS[route]
    if not call.needs:
        return None
    if kind not in SCOPES:
        return 401
    if api_keys.SCOPES.index(SCOPES[kind]) < api_keys.SCOPES.index(call.needs):
        return 403
    return 404 if kind.startswith("other") and (call.id or call.named) else None


@pytest.mark.exhaustive
def test_clip_needs_a_matte_of_the_same_owner(locked: Locked) -> None:
    url, video = f"/v1/mattes/{locked.ids['matte']}/composite", {"Content-Type": "video/mp4"}
    for kind, status in (("other", 404), ("read", 403)):
        answer = locked.service.http.post(url, content=b"clip", headers=video | bearer(locked.keys[kind]))
        assert answer.status_code == status
    assert not any(path.startswith("composites/") for path in locked.service.stored())


def test_a_dataset_needs_a_key(locked: Locked, monkeypatch: pytest.MonkeyPatch) -> None:
    url = f"{locked.service.url}/v1/mattes/{locked.ids['matte']}"
    with pytest.raises(NotAllowed):
        envmatte.open(url)
    with pytest.raises(NotFound):
        envmatte.open(url, key=locked.keys["other"])
    monkeypatch.setenv("ENVMATTE_KEY", locked.keys["read"])
    assert envmatte.open(url).alpha.compute().any()


def test_every_route_with_every_kind_of_key(locked: Locked) -> None:
    document = locked.service.http.get("/openapi.json").json()
    routes = {f"{method.upper()} {path}" for path, calls in document["paths"].items() for method in calls}
    assert routes == set(CALLS), "this test has to know how each route is called, and with what key"
    secured = {
        f"{method.upper()} {path}": "security" in call
        for path, calls in document["paths"].items()
        for method, call in calls.items()
    }
    assert secured == {route: bool(call.needs) for route, call in CALLS.items()}
    wrong = []
    ordered = sorted(CALLS, key=lambda route: CALLS[route].last)
    refused = [(route, kind) for route in ordered for kind in KINDS if expected(route, kind) is not None]
    allowed = [(route, kind) for route in ordered for kind in KINDS if expected(route, kind) is None]
    for route, kind in refused + allowed:
        if CALLS[route].last and kind == "admin":
            continue  # alice's other key has deleted it
        answer = locked.call(route, locked.keys.get(kind))
        status = expected(route, kind)
        good = answer.status_code == status if status else answer.status_code not in (401, 403, 404)
        if not good or answer.status_code >= 500 or not set(answer.headers) >= HEADERS:
            wrong.append((route, kind, answer.status_code, answer.text[:200]))
        if status and "HEAD" not in route:
            slug = {401: "unauthorized", 403: "forbidden", 404: "not-found"}[status]
            assert check_problem(answer, status, slug)["type"].endswith(slug)
        if kind.startswith("other") and status is None and CALLS[route].needs != "admin":
            leaked = [id for id in locked.ids.values() if id in answer.text]
            assert not leaked, (route, kind, "names alice's")
    assert wrong == []
    assert len(refused) > 4 * len(CALLS)


def test_any_of_the_configured_keys_is_accepted(locked: Locked) -> None:
    http = locked.service.http
    assert http.get("/healthz").status_code == 200
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {CONFIGURED[0]}"}):
        answer = http.get("/v1/captures", headers=headers)
        assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
    for key in CONFIGURED:
        assert http.get("/v1/programs", headers=bearer(key)).json() == {"programs": []}


def test_an_upload_needs_a_key(locked: Locked, capture_archive: Path) -> None:
    for method in ("OPTIONS", "POST"):
        answer = locked.service.http.request(method, "/v1/uploads", headers=TUS | {"Upload-Length": "1"})
        check_problem(answer, 401, "unauthorized")
    assert locked.service.client.upload(capture_archive)["state"] == "ingesting"


def test_the_cluster_and_the_metrics_need_a_key(locked: Locked, capture_archive: Path) -> None:
    """And the log of a service without tracing is text."""
    service, key = locked.service, bearer(CONFIGURED[0])
    for path in ("/v1/cluster", "/metrics"):
        assert service.http.get(path).status_code == 401
        assert service.http.get(path, headers=key).status_code == 200
    job = service.client.upload(capture_archive)["job"]
    service.client.wait(job)
    log = service.data.parent / f"{service.data.name}.log"
    until(lambda: f"job={job} succeeded" in log.read_text())
    text = log.read_text()
    time_and_level = r"^[-\d]+ [:,\d]+ {}"
    done = rf"{time_and_level.format('DEBUG')} services\.cluster\.task job={job} tile=0 done in"
    ended = rf"{time_and_level.format('INFO')} services\.coordinator\.job_run job={job} succeeded"
    assert re.search(done, text, re.MULTILINE)
    assert re.search(ended, text, re.MULTILINE)
    assert "opentelemetry" not in text


def test_a_program_needs_a_key_except_for_its_page(locked: Locked) -> None:
    http, key = locked.service.http, bearer(CONFIGURED[0])
    body = {"preset": "sketch", "monitor": {"width": 320, "height": 240}}
    check_problem(http.post("/v1/programs", json=body), 401, "unauthorized")
    url = http.post("/v1/programs", json=body, headers=key).headers["location"]
    for rest in ("", "/program.json", "/patterns.zip", "/patterns.mp4", "/patterns/0.png"):
        check_problem(http.get(url + rest), 401, "unauthorized")
        assert http.get(url + rest, headers=key).status_code == 200
    page = http.get(f"{url}/play")
    assert page.headers["content-type"].startswith("text/html")
    assert http.get(str(httpx2.URL(page.url).join("../../../web/play/play.js"))).status_code == 200


def test_idempotency_keys_are_per_owner(locked: Locked, capture_archive: Path) -> None:
    for create in (
        {"url": "/v1/uploads", "headers": TUS | {"Upload-Length": "5"}},
        {"url": "/v1/captures", "headers": ZIP, "content": capture_archive.read_bytes()},
    ):
        headers = create["headers"] | {"Idempotency-Key": "the-same"}
        made = [
            locked.service.http.post(**create | {"headers": headers | bearer(locked.keys[kind])}).headers[
                "location"
            ]
            for kind in ("write", "other", "admin", "other's admin")
        ]
        assert made[0] == made[2] != made[1] == made[3]


def test_programs_are_kept_per_owner(locked: Locked) -> None:
    body = {"preset": "sketch", "monitor": {"width": 64, "height": 48}}
    http = locked.service.http
    urls = {
        http.post("/v1/programs", json=body, headers=bearer(locked.keys[kind])).headers["location"]
        for kind in ("write", "other")
    }
    (url,) = urls
    assert http.delete(url, headers=bearer(locked.keys["other"])).status_code == 204
    assert http.get(url, headers=bearer(locked.keys["write"])).status_code == 200
    check_problem(http.get(url, headers=bearer(locked.keys["other"])), 404, "not-found")


def test_revoking_a_key_ends_its_running_requests(locked: Locked, capture_archive: Path) -> None:
    service, data = locked.service, locked.service.data
    made = command(data, "make", "passing", "--owner", "carol", "--json")
    key = json.loads(made.stdout)["key"]
    http = service.http
    with paused(service), Client(service.url, key) as carol:
        job = carol.upload(capture_archive)["job"]
        upload = http.post("/v1/uploads", headers=TUS | {"Upload-Length": "9"} | bearer(key)).headers[
            "location"
        ]
        with http.stream("GET", f"/v1/jobs/{job}/events", headers=bearer(key)) as stream:
            lines = stream.iter_lines()
            assert next(lines).startswith("data:") or next(lines).startswith("data:")

            def body() -> Iterator[bytes]:
                yield b"1234"
                assert command(data, "revoke", "passing").stdout == "passing: revoked\n"
                yield b"56789"

            chunk = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
            check_problem(
                http.patch(upload, content=body(), headers=chunk | bearer(key)), 401, "unauthorized"
            )
            assert not any("succeeded" in line for line in lines)  # and it ends
        check_problem(http.get(f"/v1/jobs/{job}", headers=bearer(key)), 401, "unauthorized")
    listed = command(data, "list")
    (line,) = [line for line in listed.stdout.splitlines() if line.startswith("passing")]
    name, owner, scope, created, revoked = line.split("\t")
    assert (name, owner, scope) == ("passing", "carol", "write")
    assert created <= revoked
    assert key not in listed.stdout
    assert not any(key.encode() in file.read_bytes() for file in data.glob("envmatte.db*"))
