"""The database: SQLite as it is set up, and writers that come at the same time."""

import signal
import subprocess
import sys
import threading
import time

import pytest
from sqlalchemy import Connection, Engine, select, text, update
from sqlalchemy.exc import IntegrityError

from storage.database.dialects import clock
from storage.database.engine import open_engine, reading, writing
from storage.database.tables import metadata
from storage.errors import InvalidInput, Unavailable
from storage.records import job_log, jobs, tiles
from tests.parts.postgres import Server


def test_sqlite_is_set_up(sqlite: str) -> None:
    engine = open_engine(sqlite)
    with reading(engine) as connection:
        assert connection.scalar(text("PRAGMA journal_mode")) == "wal"
        assert connection.scalar(text("PRAGMA synchronous")) == 2  # FULL
        assert connection.scalar(text("PRAGMA foreign_keys")) == 1
        assert connection.scalar(text("PRAGMA busy_timeout")) == 10000
    engine.dispose()


def test_postgresql_is_set_up(postgresql: str) -> None:
    engine = open_engine(postgresql)
    for opened, isolation, read_only in (
        (reading, "repeatable read", "on"),
        (writing, "read committed", "off"),
    ):
        with opened(engine) as connection:

            def setting(name: str, connection: Connection = connection) -> str:
                return str(connection.scalar(text(f"SHOW {name}")))

            assert setting("transaction_isolation") == isolation
            assert setting("transaction_read_only") == read_only
            assert setting("lock_timeout") == "20s"
            assert setting("idle_in_transaction_session_timeout") == "10s"
            assert setting("statement_timeout") == "1min"
    engine.dispose()


@pytest.mark.parametrize(
    "url", ["", "here", "mysql://user:secret@host/name", "postgresql://host:secret/name"]
)
def test_a_url_of_no_such_database_is_told_without_repeating_it(url: str) -> None:
    with pytest.raises(InvalidInput, match="must be sqlite:") as caught:
        open_engine(url)
    assert "secret" not in str(caught.value)


def test_what_was_written_is_there_when_opened_again(engine: Engine, url: str) -> None:
    with writing(engine) as connection:
        job = jobs.add(connection, "ingest", "c", {})
    engine.dispose()
    again = open_engine(url)
    with reading(again) as connection:
        assert jobs.get(connection, job).state == "queued"
    again.dispose()


def test_an_exception_rolls_back(engine: Engine) -> None:
    with pytest.raises(ZeroDivisionError), writing(engine) as connection:  # noqa: PT012
        jobs.add(connection, "ingest", "c", {})
        raise ZeroDivisionError
    with reading(engine) as connection:
        assert jobs.active(connection) == []


def test_a_tile_needs_its_job(engine: Engine) -> None:
    with pytest.raises(IntegrityError), writing(engine) as connection:
        job_log.add(connection, "none", "a line")


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
                    # Without the lock from the start SQLite refuses the write below, and PostgreSQL loses one.
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


def test_a_reader_does_not_wait_for_a_writer(engine: Engine) -> None:
    with writing(engine) as writer:
        job = jobs.add(writer, "ingest", "c", {})
        start = time.monotonic()
        with reading(engine) as reader:
            assert jobs.active(reader) == []
        assert time.monotonic() - start < 5
    with reading(engine) as reader:
        assert [row.id for row in jobs.active(reader)] == [job]


def test_the_clock_is_in_seconds_since_1970_and_goes_on_within_a_transaction(engine: Engine) -> None:
    with writing(engine) as connection:
        before = time.time()
        first = connection.scalar(select(clock()))
        time.sleep(0.05)
        then = connection.scalar(select(clock()))
    assert isinstance(first, float)
    assert abs(first - before) < 60
    assert then > first
    with writing(engine) as connection:
        job = jobs.add(connection, "ingest", "c", {})
        connection.execute(update(metadata.tables["jobs"]).values(stage_at=clock() + 10))
        assert abs(jobs.get(connection, job).stage_at - then - 10) < 60


def test_a_reader_sees_the_database_as_it_was_at_one_time(engine: Engine) -> None:
    with reading(engine) as reader:
        assert jobs.active(reader) == []
        with writing(engine) as writer:
            jobs.add(writer, "ingest", "c", {})
        assert jobs.active(reader) == []
    with reading(engine) as reader:
        assert len(jobs.active(reader)) == 1


@pytest.mark.parametrize("wait", ["sqlite", "postgresql"])
def test_a_writer_that_waits_too_long_is_told_to_try_again(wait: str, request: pytest.FixtureRequest) -> None:
    url = request.getfixturevalue(wait)
    one, other = open_engine(url), open_engine(url)
    with other.connect() as connection:  # which the pool hands out again
        shorter = {"sqlite": "PRAGMA busy_timeout=10", "postgresql": "SET lock_timeout = '10ms'"}
        connection.execute(text(shorter[wait]))
        connection.commit()
    with writing(one):
        with pytest.raises(Unavailable, match="try again"), writing(other):
            pass
        with reading(other) as connection:
            assert jobs.active(connection) == []
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
def test_a_database_that_is_not_there(url: str) -> None:
    with pytest.raises(Unavailable, match=r"cannot open the database .*; check that it runs") as caught:
        open_engine(url)
    told: BaseException | None = caught.value
    while told is not None:
        assert "secret" not in str(told)
        told = told.__cause__


def test_the_pool_recovers_from_a_restart_of_the_server(postgresql: str, postgresql_server: Server) -> None:
    engine = open_engine(postgresql)
    with writing(engine) as connection:
        jobs.add(connection, "ingest", "c", {})
    postgresql_server.restart()
    with reading(engine) as connection:
        assert len(jobs.active(connection)) == 1
    postgresql_server.restart()
    with writing(engine) as connection:
        jobs.add(connection, "ingest", "c", {})
    engine.dispose()


def test_a_server_that_stops_takes_a_transaction_along(postgresql: str, postgresql_server: Server) -> None:
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
        assert jobs.active(connection) == []
    engine.dispose()


def test_what_postgresql_can_not_hold_is_bad_input(postgresql: str) -> None:
    engine = open_engine(postgresql)
    with pytest.raises(InvalidInput, match="NUL"), reading(engine) as connection:
        jobs.get(connection, "a\0b")
    with pytest.raises(InvalidInput, match="too long"), writing(engine) as connection:
        jobs.add(connection, "ingest", "c" * 33, {})
    engine.dispose()


HOLD = """
import sys
from sqlalchemy import text
from storage.database.engine import open_engine, writing
with writing(open_engine(sys.argv[1])) as connection:
    print("inside", flush=True)
    sys.stdin.readline()
    connection.execute(text("SELECT 1"))
"""


@pytest.mark.slow
def test_a_writer_that_is_frozen_is_shut_out(postgresql: str) -> None:
    engine = open_engine(postgresql)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HOLD, postgresql], text=True, **pipes) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "inside\n"
        holder.send_signal(signal.SIGSTOP)
        with writing(engine) as connection:
            job = jobs.add(connection, "ingest", "c", {})
        holder.send_signal(signal.SIGCONT)
        assert "storage.errors.Unavailable: " in holder.communicate("\n", timeout=60)[1]
        assert holder.returncode == 1
    with reading(engine) as connection:
        assert jobs.get(connection, job).state == "queued"
    engine.dispose()
