"""Uploads whose rows and bytes must agree, and their keys: the app with a real database and store."""

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine, PoolProxiedConnection, event, func, select

from storage.database.engine import open_engine, reading
from storage.database.tables import uploads
from storage.objects.store import Objects
from tests.parts.captures import nested_program
from tests.parts.postgres import Server
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

TUS = {"Tus-Resumable": "1.0.0"}
CHUNK = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    engine = open_engine(database_url)
    yield engine
    engine.dispose()


@pytest.fixture
def client(build: Callable[..., FastAPI]) -> Iterator[TestClient]:
    with TestClient(build(), "http://127.0.0.1") as client:
        yield client


def create(client: TestClient, length: int) -> str:
    headers = TUS | {"Upload-Length": str(length), "Idempotency-Key": "a file"}
    return str(client.post("/v1/uploads", headers=headers).headers["location"])


def offset_of(client: TestClient, where: str) -> str:
    return str(client.head(where, headers=TUS).headers["upload-offset"])


def break_commit(
    engine: Engine, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, committed: bool
) -> list[str]:
    """Break the connection at the commit that records a part, before it or before its answer; returns what broke."""
    commit, statements, broken = engine.dialect.do_commit, [], []

    @event.listens_for(engine, "after_cursor_execute")
    def executed(connection: object, cursor: object, sql: str, *more: object) -> None:
        statements.append(sql)

    def do_commit(connection: PoolProxiedConnection) -> None:
        breaks = not broken and any(sql.startswith("INSERT INTO upload_parts") for sql in statements)
        if committed or not breaks:
            commit(connection)
        if not breaks:
            return
        broken.append("commit")
        if engine.dialect.name == "postgresql":
            server: Server = request.getfixturevalue("postgresql_server")
            assert connection.dbapi_connection is not None
            server.execute(f"SELECT pg_terminate_backend({connection.dbapi_connection.info.backend_pid})")
            connection.cursor().execute("SELECT 1")
        error = sqlite3.OperationalError()
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR
        raise error

    monkeypatch.setattr(engine.dialect, "do_commit", do_commit)
    return broken


@pytest.mark.parametrize("committed", [False, True])
def test_part_is_kept_if_it_was_recorded_although_the_connection_broke(
    client: TestClient,
    engine: Engine,
    objects: Objects,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    committed: bool,
) -> None:
    where = create(client, 5)
    broken = break_commit(engine, request, monkeypatch, committed)
    assert client.patch(where, headers=CHUNK, content=b"first").status_code == 503
    assert broken == ["commit"]
    names = objects.names(f"uploads/{where.rsplit('/', 1)[1]}")
    assert (offset_of(client, where), len(names)) == (("5", 1) if committed else ("0", 0))


def test_upload_whose_bytes_are_gone_is_started_again(
    client: TestClient, objects: Objects, tmp_path: Path
) -> None:
    file = tmp_path / "ball.zip"
    write_capture(
        glass_ball.glass_ball(24, 16, rays=1), nested_program(bands=((8, 6, 16),), levels=2), file, name="b"
    )
    data = file.read_bytes()
    where = create(client, len(data))
    assert client.patch(where, headers=CHUNK, content=data).status_code == 204
    (name,) = objects.names(folder := f"uploads/{where.rsplit('/', 1)[1]}")
    objects.delete(f"{folder}/{name}")
    body = {"upload": where.rsplit("/", 1)[1]}
    answer = client.post("/v1/captures", json=body)
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:envmatte:problem:not-found")
    assert "missing or damaged in the store" in answer.json()["detail"]
    assert objects.names("uploads") == []
    again = create(client, len(data))
    assert (again != where, offset_of(client, again)) == (True, "0")
    assert client.patch(again, headers=CHUNK, content=data).status_code == 204
    answer = client.post("/v1/captures", json={"upload": again.rsplit("/", 1)[1]})
    assert answer.status_code == 201, answer.text


def test_empty_body_leaves_no_object(client: TestClient, objects: Objects) -> None:
    where = create(client, 5)
    assert client.patch(where, headers=CHUNK, content=b"").status_code == 204
    assert (offset_of(client, where), objects.paths_below("uploads")) == ("0", set())


def test_empty_key_creates_in_any_case(client: TestClient) -> None:
    headers = TUS | {"Upload-Length": "5", "Idempotency-Key": ""}
    answers = [client.post("/v1/uploads", headers=headers) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 201]
    assert answers[0].headers["location"] != answers[1].headers["location"]


@pytest.mark.parametrize(
    ("length", "content", "extra", "status"),
    [
        (4, b"first", {}, 413),
        (4, [b"fir", b"st"], {}, 413),
        (5, b"first", {"Upload-Checksum": "sha1 AAAA"}, 460),
    ],
    ids=["announced", "streamed", "checksum"],
)
def test_refused_body_of_a_creation_leaves_no_upload(
    client: TestClient,
    engine: Engine,
    objects: Objects,
    length: int,
    content: bytes | list[bytes],
    extra: dict[str, str],
    status: int,
) -> None:
    headers = CHUNK | {"Upload-Length": str(length)} | extra
    assert client.post("/v1/uploads", headers=headers, content=content).status_code == status
    with reading(engine) as c:
        assert c.scalar(select(func.count()).select_from(uploads)) == 0
    assert objects.names("uploads") == []
