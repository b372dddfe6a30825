"""Opening a database, and transactions: concurrent, interrupted, too slow, or without a server."""

import logging
import signal
import subprocess
import sys
import threading
import time

import pytest
from sqlalchemy import Engine, text, update
from sqlalchemy.exc import IntegrityError

from storage.database import dialects
from storage.database.engine import open_engine, reading, writing
from storage.database.tables import metadata
from storage.errors import InvalidInput, Unavailable
from storage.outage import Outage
from storage.records import jobs, tiles
from tests.parts.postgres import Server


def test_rows_persist_after_reopening(engine: Engine, database_url: str) -> None:
    with writing(engine) as connection:
        job = jobs.add(connection, "ingest", "c", {})
    engine.dispose()
    again = open_engine(database_url)
    with reading(again) as connection:
        assert jobs.get(connection, job).state == "queued"
    again.dispose()


def test_exception_rolls_back(engine: Engine) -> None:
    with pytest.raises(ZeroDivisionError), writing(engine) as connection:  # noqa: PT012
        jobs.add(connection, "ingest", "c", {})
        raise ZeroDivisionError
    with reading(engine) as connection:
        assert jobs.to_run(connection) == []


def test_log_line_needs_its_job(engine: Engine) -> None:
    with pytest.raises(IntegrityError), writing(engine) as connection:
        jobs.log(connection, "none", "a line")


def test_writers_that_read_first_wait_for_each_other(engine: Engine) -> None:
    with writing(engine) as connection:
        job = jobs.add(connection, "ingest", "c", {})
        tiles.add_plan(connection, job, {"tiles": 40})
    failed: list[BaseException] = []
    inside = threading.Barrier(2)

    def work(own: range) -> None:
        try:
            inside.wait()
            for tile in own:
                with writing(engine) as connection:
                    # Without the lock from the start, SQLite refuses the write below, and PostgreSQL loses one.
                    seen = jobs.get(connection, job).paced_done
                    time.sleep(0.002)
                    connection.execute(update(metadata.tables["jobs"]).values(paced_done=seen + 1))
                    tiles.mark_done(connection, job, [(tile, 0.1, 10)])
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=work, args=(range(at, 40, 2),)) for at in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    with reading(engine) as connection:
        row = jobs.get(connection, job)
        assert (row.done, row.pixels, row.paced_done) == (40, 400, 40)
        assert tiles.remaining(connection, job) == []


def test_reader_does_not_wait_for_writer(engine: Engine) -> None:
    with writing(engine) as writer:
        job = jobs.add(writer, "ingest", "c", {})
        start = time.monotonic()
        with reading(engine) as reader:
            assert jobs.to_run(reader) == []
        assert time.monotonic() - start < 5
    with reading(engine) as reader:
        assert [row.id for row in jobs.to_run(reader)] == [job]


def test_reader_sees_one_snapshot(engine: Engine) -> None:
    with reading(engine) as reader:
        assert jobs.to_run(reader) == []
        with writing(engine) as writer:
            jobs.add(writer, "ingest", "c", {})
        assert jobs.to_run(reader) == []
    with reading(engine) as reader:
        assert len(jobs.to_run(reader)) == 1


@pytest.mark.parametrize("wait", ["sqlite", "postgresql"])
def test_writer_that_waits_too_long_gets_unavailable(wait: str, request: pytest.FixtureRequest) -> None:
    url = request.getfixturevalue(wait)
    one, other = open_engine(url), open_engine(url)
    with other.connect() as connection:  # the pool hands it out again
        shorter = {"sqlite": "PRAGMA busy_timeout=10", "postgresql": "SET lock_timeout = '10ms'"}
        connection.execute(text(shorter[wait]))
        connection.commit()
    with writing(one):
        with pytest.raises(Unavailable, match="try again"), writing(other):
            pass
        with reading(other) as connection:
            assert jobs.to_run(connection) == []
    with writing(other) as connection:
        jobs.add(connection, "ingest", "c", {})
    one.dispose()
    other.dispose()


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://user:secret@127.0.0.1:1/name?sslpassword=secret",
        "postgresql://user:secret@/name?host=/nowhere",
        "sqlite:////nowhere/at/all.db",
    ],
)
def test_unreachable_database_is_reported_without_password(url: str) -> None:
    with pytest.raises(Unavailable, match=r"cannot open the database .*; check that it runs") as caught:
        open_engine(url)
    error: BaseException | None = caught.value
    while error is not None:
        assert "secret" not in str(error)
        error = error.__cause__


def test_user_without_rights_learns_who_must_own_the_database(postgresql_server: Server) -> None:
    postgresql_server.execute("CREATE ROLE guest LOGIN")
    with postgresql_server.database() as url:
        with pytest.raises(InvalidInput, match="let its user own the database") as caught:
            open_engine(url.replace("postgres@", "guest:secret@"))
        assert "guest:***@/test_" in caught.value.detail
        assert "permission denied" in caught.value.detail
    postgresql_server.execute("DROP ROLE guest")


def test_an_absent_server_is_logged_when_it_goes_and_when_it_is_back(
    postgresql: str,
    postgresql_server: Server,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(dialects, "outage", Outage(logging.getLogger("storage.database.dialects")))
    engine = open_engine(postgresql)
    with caplog.at_level(logging.INFO, "storage"):
        with postgresql_server.stopped():
            for _ in range(5):
                with pytest.raises(Unavailable), reading(engine):
                    pass
        for _ in range(2):
            with reading(engine):
                pass
    engine.dispose()
    away, back = [record.getMessage() for record in caplog.records]
    assert away.startswith("the database cannot be reached: ")
    assert back == "the database answers"


def test_pool_recovers_from_server_restart(postgresql: str, postgresql_server: Server) -> None:
    engine = open_engine(postgresql)
    with writing(engine) as connection:
        jobs.add(connection, "ingest", "c", {})
    postgresql_server.restart()
    with reading(engine) as connection:
        assert len(jobs.to_run(connection)) == 1
    postgresql_server.restart()
    with writing(engine) as connection:
        jobs.add(connection, "ingest", "c", {})
    engine.dispose()


def test_server_stop_rolls_back_transaction(postgresql: str, postgresql_server: Server) -> None:
    engine = open_engine(postgresql)
    with pytest.raises(Unavailable, match="try again"), writing(engine) as connection:  # noqa: PT012
        jobs.add(connection, "ingest", "c", {})
        postgresql_server.restart()
        jobs.add(connection, "ingest", "c", {})
    with pytest.raises(Unavailable), writing(engine) as connection:  # noqa: PT012
        jobs.add(connection, "ingest", "c", {})
        postgresql_server.restart()
    with postgresql_server.stopped():
        with pytest.raises(Unavailable, match="try again"), writing(engine):
            pass
        with pytest.raises(Unavailable, match="try again"), reading(engine):
            pass
    with reading(engine) as connection:
        assert jobs.to_run(connection) == []
    engine.dispose()


HOLD = """
import sys
from sqlalchemy import text
from storage.database import dialects
from storage.database.engine import open_engine, writing
with writing(open_engine(sys.argv[1])) as connection:
    print("inside", flush=True)
    sys.stdin.readline()
    connection.execute(text("SELECT 1"))
"""


@pytest.mark.slow
def test_frozen_writer_loses_its_transaction(postgresql: str) -> None:
    engine = open_engine(postgresql)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HOLD, postgresql], text=True, **pipes) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "inside\n"
        holder.send_signal(signal.SIGSTOP)
        with writing(engine) as connection:
            job = jobs.add(connection, "ingest", "c", {})
        holder.send_signal(signal.SIGCONT)
        assert "storage.errors.Unavailable: " in holder.communicate("\n", timeout=300)[1]
        assert holder.returncode == 1
    with reading(engine) as connection:
        assert jobs.get(connection, job).state == "queued"
    engine.dispose()
