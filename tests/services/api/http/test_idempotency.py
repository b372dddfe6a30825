"""Repeated requests with one Idempotency-Key: one thing is created, and every answer is about it."""

import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import Connection, Engine, PoolProxiedConnection

from services.api.http import idempotency
from services.api.http.idempotency import find_earlier, idempotent
from storage.database.engine import open_engine, reading, writing
from storage.errors import NotFound, Unavailable
from storage.records import jobs

CALL = "POST /v1/jobs"


def create(connection: Connection) -> str:
    return jobs.add(connection, "recover", "cap", {}, "mat")


def count(engine: Engine) -> int:
    with reading(engine) as c:
        return len(jobs.to_run(c))


def test_repeat_with_key_answers_with_first(engine: Engine) -> None:
    assert find_earlier(engine, "a", CALL, jobs.get) is None
    first = idempotent(engine, "a", CALL, jobs.get, create)
    assert idempotent(engine, "a", CALL, jobs.get, create).id == first.id
    earlier = find_earlier(engine, "a", CALL, jobs.get)
    assert earlier is not None
    assert earlier.id == first.id
    assert count(engine) == 1


@pytest.mark.parametrize("key", [None, ""])
def test_without_key_each_request_creates(engine: Engine, key: str | None) -> None:
    assert idempotent(engine, key, CALL, jobs.get, create) != idempotent(engine, key, CALL, jobs.get, create)
    assert find_earlier(engine, key, CALL, jobs.get) is None
    assert count(engine) == 2


def test_key_counts_once_for_each_route(engine: Engine) -> None:
    idempotent(engine, "a", CALL, jobs.get, create)
    idempotent(engine, "a", "POST /v1/captures", jobs.get, create)
    assert count(engine) == 2


def test_repeat_after_deletion_is_not_found(engine: Engine) -> None:
    first = idempotent(engine, "a", CALL, jobs.get, create)
    with writing(engine) as c:
        jobs.end(c, first.id, "failed", {"detail": "its capture is damaged"})
        jobs.delete(c, first.id)
    with pytest.raises(NotFound, match="use another key"):
        find_earlier(engine, "a", CALL, jobs.get)
    with pytest.raises(NotFound, match="use another key"):
        idempotent(engine, "a", CALL, jobs.get, create)
    assert count(engine) == 0


def test_concurrent_repeats_create_once(database_url: str) -> None:
    engine = open_engine(database_url)
    begun = threading.Barrier(4)

    def create_slowly(connection: Connection) -> str:
        time.sleep(0.2)  # the others begin meanwhile
        return create(connection)

    def repeat() -> str:
        begun.wait()
        return str(idempotent(engine, "a", CALL, jobs.get, create_slowly).id)

    with ThreadPoolExecutor(4) as pool:
        answers = [pool.submit(repeat) for _ in range(4)]
    assert len({answer.result() for answer in answers}) == 1
    assert count(engine) == 1
    engine.dispose()


@pytest.mark.parametrize("committed", [False, True])
def test_transaction_whose_connection_breaks_creates_once(
    engine: Engine, monkeypatch: pytest.MonkeyPatch, committed: bool
) -> None:
    """As by a restart of PostgreSQL, before the commit or before its answer."""
    broken = sqlite3.OperationalError()
    broken.sqlite_errorcode = sqlite3.SQLITE_IOERR
    commit, breaks = engine.dialect.do_commit, [broken]

    def do_commit(connection: PoolProxiedConnection) -> None:
        if committed or not breaks:
            commit(connection)
        if breaks:
            raise breaks.pop()

    monkeypatch.setattr(engine.dialect, "do_commit", do_commit)
    monkeypatch.setattr(idempotency, "PAUSE", 0)

    def create(connection: Connection) -> str:
        return jobs.add(connection, "recover", "cap", {}, "mat", job="job")

    assert idempotent(engine, None, CALL, jobs.get, create, "job").id == "job"
    assert (breaks, count(engine)) == ([], 1)


def test_database_that_stays_away_is_given_up(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    def create(connection: Connection) -> str:
        raise Unavailable("it is away")

    monkeypatch.setattr(idempotency, "PATIENCE", 0.1)
    with pytest.raises(Unavailable):
        idempotent(engine, None, CALL, jobs.get, create, "job")
