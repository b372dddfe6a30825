"""SQLite and PostgreSQL: how they are set up, their clocks, and the meaning of their errors."""

import secrets
import shutil
import stat
import time
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine, select, text, update

from storage.database.dialects import clock
from storage.database.engine import open_engine, reading, writing
from storage.database.tables import metadata
from storage.errors import InvalidInput, NoRoom
from storage.records import jobs, uploads
from tests.parts.disks import small_disk
from tests.parts.postgres import TEMPLATE, Server
from tests.storage.conftest import DISK


def test_sqlite_settings(sqlite: str) -> None:
    engine = open_engine(sqlite)
    with reading(engine) as connection:
        assert connection.scalar(text("PRAGMA journal_mode")) == "wal"
        assert connection.scalar(text("PRAGMA synchronous")) == 2  # FULL
        assert connection.scalar(text("PRAGMA foreign_keys")) == 1
        assert connection.scalar(text("PRAGMA busy_timeout")) == 10000
    engine.dispose()


def test_files_of_sqlite_are_their_owners_alone(tmp_path: Path) -> None:
    file = tmp_path / "envmatte.db"
    old = [Path(f"{file}{end}") for end in ("", "-wal")]
    for path in old:
        path.touch()
        path.chmod(0o644)
    engine = open_engine(f"sqlite:///{file}")
    with reading(engine):
        found = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert found == {f"envmatte.db{end}": 0o600 for end in ("", "-wal", "-shm")}
    engine.dispose()


def test_postgresql_settings(postgresql: str) -> None:
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
def test_unsupported_url_is_refused_without_repeating_it(url: str) -> None:
    with pytest.raises(InvalidInput, match="must be postgresql:") as caught:
        open_engine(url)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("url", ["sqlite://", "sqlite:///:memory:", "sqlite:///here.db"])
def test_file_of_sqlite_is_named_from_the_root_on(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidInput, match="four slashes"):
        open_engine(url)
    assert list(tmp_path.iterdir()) == []


def test_clock_advances_within_a_transaction(engine: Engine) -> None:
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


def test_value_that_postgresql_cannot_store_is_invalid_input(postgresql: str) -> None:
    engine = open_engine(postgresql)
    with pytest.raises(InvalidInput, match="NUL"), reading(engine) as connection:
        jobs.get(connection, "a\0b")
    with pytest.raises(InvalidInput, match="too long"), writing(engine) as connection:
        jobs.add(connection, "ingest", "c" * 33, {})
    engine.dispose()


def test_sqlite_on_full_disk_keeps_rows(disk: Path) -> None:
    engine = open_engine(f"sqlite:///{disk / 'ledger.db'}")
    with writing(engine) as c:
        uploads.add(c, "before", 10, "", 1000.0, None)
    filler = disk / "filler"
    with filler.open("wb", 0) as file:
        while True:
            try:
                file.write(bytes(4096))
            except OSError:
                break
    with pytest.raises(NoRoom, match="free space"), writing(engine) as c:
        uploads.add(c, "upload 0", 10, "x" * 1_000_000, 1000.0, None)
    with engine.connect() as c:
        assert uploads.get(c, "before").length == 10
    filler.unlink()
    with writing(engine) as c:
        uploads.add(c, "upload 0", 10, "", 1000.0, None)
    engine.dispose()


def test_postgresql_on_full_disk_keeps_rows(postgresql_server: Server) -> None:
    server = postgresql_server
    with small_disk(server.folder / "disk", 2 * DISK) as disk:
        shutil.chown(disk, server.folder.owner())
        server.execute(f"CREATE TABLESPACE small LOCATION '{disk}'")
        with server.database(like=f"{TEMPLATE} TABLESPACE small") as url:
            engine = open_engine(url)
            with writing(engine) as c:
                uploads.add(c, "before", 10, "", 1000.0, None)
            big = secrets.token_hex(DISK)  # random, so that it cannot be compressed to fit
            with pytest.raises(NoRoom, match="free space"), writing(engine) as c:
                uploads.add(c, "big", 10, big, 1000.0, None)
            with writing(engine) as c:
                assert uploads.get(c, "before").length == 10
                uploads.add(c, "small", 10, "", 1000.0, None)
            engine.dispose()
        server.execute("DROP TABLESPACE small")
