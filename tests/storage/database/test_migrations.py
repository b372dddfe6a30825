"""Schema migrations: databases of every age end with the same tables and keep their rows."""

import json
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, Engine, func, inspect, select, text
from sqlalchemy.exc import DatabaseError, IntegrityError

from storage.database import dialects, migrations
from storage.database.engine import open_engine, reading, writing
from storage.database.owners import DEFAULT, for_owner
from storage.database.revision import NEWEST, revision
from storage.database.rows import json_bytes
from storage.database.tables import coordinator, metadata, tiles, totals
from storage.errors import Conflict, NotFound, Unavailable
from storage.layout.uploads import Part
from storage.records import captures, idempotency, jobs, mattes, programs, uploads
from storage.records import tiles as tile_records
from storage.statistics import stored_bytes
from tests.parts.postgres import Server

BEFORE_REVISIONS = Path(__file__).with_name("before_revisions.sql")
OPEN = """
import sys
from storage.database.engine import open_engine, reading
from storage.database.revision import revision
print("ready", flush=True)
sys.stdin.readline()
engine = open_engine(sys.argv[1])
with reading(engine) as connection:
    print(revision(connection))
"""

LOGGED = """
import logging, sys
from storage.database.engine import open_engine
logging.basicConfig(level=logging.INFO)
logging.getLogger("alembic").setLevel(logging.WARNING)  # as services.runtime.logs does
for _ in range(2):
    open_engine(sys.argv[1]).dispose()
"""


@pytest.fixture
def old(tmp_path: Path) -> str:
    """The URL of a SQLite database with the tables and some rows from before there were revisions."""
    path = tmp_path / "old.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(BEFORE_REVISIONS.read_text())
        connection.execute(
            "INSERT INTO jobs VALUES (7, 'j', 'recover', 'running', 'recovering', 'c', 'm', '{}', '{\"tiles\": 2}', "
            "2, 1, 0, 10, NULL, 1000.5, 1001.5, NULL)"
        )
        connection.execute("INSERT INTO tiles VALUES ('j', 0, 'done', 1, 0.5), ('j', 1, 'queued', 2, NULL)")
        connection.execute("INSERT INTO log VALUES (3, 'j', 1000.5, 'queued')")
        connection.execute("INSERT INTO coordinator VALUES (1, 1000.5, 2, 2)")
        connection.commit()
    return f"sqlite:///{path}"


@pytest.fixture(params=["sqlite", "postgresql"])
def bare(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Engine]:
    """An empty database, opened without an upgrade."""
    if request.param == "sqlite":
        engine = dialects.make_engine(f"sqlite:///{tmp_path}/bare.db")
        yield engine
        engine.dispose()
    else:
        server: Server = request.getfixturevalue("postgresql_server")
        with server.database() as url:
            engine = dialects.make_engine(url)
            yield engine
            engine.dispose()


def differences(connection: Connection) -> list[Any]:
    options = {"compare_type": True, "compare_server_default": True}
    return list(compare_metadata(MigrationContext.configure(connection, opts=options), metadata))


def schema(engine: Engine) -> dict[str, Any]:
    """All about the tables, as read from the database."""
    found = inspect(engine)
    return {
        name: (
            [(c["name"], str(c["type"]), c["nullable"], c["default"]) for c in found.get_columns(name)],
            found.get_pk_constraint(name),
            found.get_foreign_keys(name),
            sorted(str(u["column_names"]) for u in found.get_unique_constraints(name)),
            sorted((str(i["name"]), str(i["column_names"])) for i in found.get_indexes(name)),
        )
        for name in found.get_table_names()
        if name != "alembic_version"
    }


def test_newest_revision_equals_tables(engine: Engine) -> None:
    with reading(engine) as connection:
        assert revision(connection) == NEWEST == max(migrations.known())
        assert differences(connection) == []
    assert set(schema(engine)) == set(metadata.tables)


def test_schema_comparison_finds_differences(engine: Engine) -> None:
    with writing(engine) as connection:
        connection.execute(text("ALTER TABLE jobs ADD COLUMN more INTEGER"))
        assert [found[0] for found in differences(connection)] == ["remove_column"]


def test_first_revision_equals_schema_before_revisions(old: str, tmp_path: Path) -> None:
    before, first = dialects.make_engine(old), dialects.make_engine(f"sqlite:///{tmp_path}/first.db")
    with writing(first) as connection:
        migrations.upgrade(connection, "0001")
    assert schema(first) == schema(before)
    before.dispose()
    first.dispose()


def test_database_without_revision_keeps_its_rows(old: str) -> None:
    engine = open_engine(old)
    with reading(engine) as connection:
        assert differences(connection) == []
        row = jobs.get(connection, "j")
        assert (row.number, row.plan, row.done, row.pixels, row.created_at) == (
            7,
            {"tiles": 2},
            1,
            10,
            1000.5,
        )
        assert (row.paced_done, row.stage_at, row.moved_at, row.paced_at, row.trace) == (0, *(None,) * 4)
        assert connection.execute(select(tiles).order_by(tiles.c.tile)).all() == [
            ("j", 0, "done", 1, 0.5, 0),
            ("j", 1, "queued", 2, None, 0),
        ]
        assert [row.line for row in jobs.log_lines(connection, "j", 0, 10)] == [3]
        for table in (coordinator, totals):
            assert connection.scalar(select(func.count()).select_from(table)) == 0
    with writing(engine) as connection:
        tile_records.mark_done(connection, "j", [(1, 0.5, 10)])
        assert jobs.get(connection, "j").done == 2
    engine.dispose()


def test_older_database_gets_missing_tables(old: str) -> None:
    with closing(sqlite3.connect(old.removeprefix("sqlite:///"))) as connection:
        for table in ("upload_parts", "uploads", "made", "programs"):
            connection.execute(f"DROP TABLE {table}")
    engine = open_engine(old)
    with reading(engine) as connection:
        assert differences(connection) == []
        assert jobs.get(connection, "j").number == 7
    engine.dispose()


def test_failed_upgrade_leaves_old_schema(bare: Engine) -> None:
    with writing(bare) as connection:
        migrations.upgrade(connection, "0001")
        connection.execute(text("CREATE TABLE totals (in_the_way INTEGER)"))
        connection.execute(
            text(
                "INSERT INTO jobs (id, kind, state, stage, capture, options, total, done, failed, pixels, created_at) "
                "VALUES ('j', '', '', '', '', '{}', 0, 0, 0, 0, 0)"
            )
        )
    before = schema(bare)
    url = bare.url.render_as_string(hide_password=False)
    with pytest.raises(DatabaseError, match="totals"):
        open_engine(url)
    assert schema(bare) == before
    with writing(bare) as connection:
        assert revision(connection) == "0001"
        connection.execute(text("DROP TABLE totals"))
    engine = open_engine(url)
    with reading(engine) as connection:
        assert jobs.get(connection, "j").paced_done == 0
        assert differences(connection) == []
    engine.dispose()


def test_upgrade_on_postgresql_may_take_long(
    postgresql_server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(dialects.TIMEOUTS, "statement_timeout", "200ms")
    with postgresql_server.database() as url:
        bare = dialects.make_engine(url)
        with writing(bare) as connection:
            migrations.upgrade(connection, "0001")
            connection.exec_driver_sql(
                "CREATE FUNCTION wait() RETURNS event_trigger LANGUAGE plpgsql AS 'BEGIN PERFORM pg_sleep(0.4); END'"
            )
            connection.exec_driver_sql("CREATE EVENT TRIGGER slow ON ddl_command_end EXECUTE FUNCTION wait()")
        with writing(bare) as connection:
            migrations.upgrade(connection, "0002")
            assert revision(connection) == "0002"
        with pytest.raises(Unavailable), writing(bare) as connection:  # later statements are limited again
            connection.exec_driver_sql("SELECT pg_sleep(1)")
        bare.dispose()


def test_newer_database_is_refused_and_unchanged(engine: Engine, database_url: str) -> None:
    with writing(engine) as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(Conflict, match=r"revision 9999, .* up to \d{4}; install the newer envmatte"):
        open_engine(database_url)
    with reading(engine) as connection:
        assert revision(connection) == "9999"
        assert differences(connection) == []


def test_concurrent_processes_upgrade_once(bare: Engine) -> None:
    command = [sys.executable, "-c", OPEN, bare.url.render_as_string(hide_password=False)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    processes = [subprocess.Popen(command, text=True, **pipes) for _ in range(2)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    outputs = [process.communicate(timeout=300) for process in processes]
    assert outputs == [(f"{NEWEST}\n", "")] * 2
    with reading(bare) as connection:
        assert differences(connection) == []


def test_upgrade_is_logged_in_one_line(old: str) -> None:
    done = subprocess.run([sys.executable, "-c", LOGGED, old], capture_output=True, text=True, check=True)
    upgraded = f"upgraded the database schema from revision none to {NEWEST}"
    assert (done.stdout, done.stderr) == ("", f"INFO:storage.database.migrations:{upgraded}\n")


def test_upgrade_to_imported_mattes_keeps_rows(bare: Engine) -> None:
    with writing(bare) as connection:
        migrations.upgrade(connection, "0003")
        connection.execute(
            text(
                "INSERT INTO mattes (id, capture, job, state, options, created_at) "
                "VALUES ('m', 'c', 'j', 'ready', '{}', 1000.5)"
            )
        )
    engine = open_engine(bare.url.render_as_string(hide_password=False))
    with writing(engine) as connection:
        assert differences(connection) == []
        mattes.add_imported(connection, "n", {"method": "lobes"}, {"width": 7})
        old, new = mattes.get(connection, "m"), mattes.get(connection, "n")
    assert (old.capture, old.job, old.created_at) == ("c", "j", 1000.5)
    assert (new.capture, new.job, new.state, new.figures) == (None, None, "ready", {"width": 7})
    assert new.number > old.number
    with pytest.raises(IntegrityError), writing(engine) as connection:  # ids are still unique
        mattes.add_imported(connection, "m", {}, {})
    engine.dispose()


OF_0004 = """
INSERT INTO captures (id, name, state, job, bytes, frames, program, created_at)
VALUES ('c', 'ball', 'ready', 'j', 5, 4, '{}', 1000.5);
INSERT INTO mattes (id, capture, job, state, options, created_at) VALUES ('m', 'c', 'j', 'ready', '{}', 1000.5);
INSERT INTO programs (id, program, created_at) VALUES ('p', '{}', 1000.5);
INSERT INTO jobs (id, kind, state, stage, capture, options, total, done, failed, pixels, created_at)
VALUES ('j', 'recover', 'succeeded', 'succeeded', 'c', '{}', 1, 1, 0, 5, 1000.5);
INSERT INTO tiles (job, tile, state, attempts) VALUES ('j', 0, 'done', 1);
INSERT INTO uploads (id, key, "offset", length, parts, metadata, created_at, expires_at)
VALUES ('u', 'again', 3, 5, 2, '', 1000.5, 1e12);
INSERT INTO upload_parts (upload, "offset", name, size) VALUES ('u', 0, 'a', 1);
INSERT INTO upload_parts (upload, "offset", name, size) VALUES ('u', 1, 'b', 2);
INSERT INTO made (key, call, id) VALUES ('again', 'POST', 'c')
"""


def test_rows_before_owners_belong_to_default_owner(bare: Engine) -> None:
    with writing(bare) as connection:
        migrations.upgrade(connection, "0004")
        for statement in OF_0004.split(";"):
            connection.exec_driver_sql(statement)
    engine = open_engine(bare.url.render_as_string(hide_password=False))
    with writing(for_owner(engine, DEFAULT)) as connection:
        for get, id in ((captures.get, "c"), (mattes.get, "m"), (programs.get, "p"), (jobs.get, "j")):
            row = get(connection, id)
            assert (row.owner, row.created_at, row.number) == (DEFAULT, 1000.5, 1)
        assert captures.get(connection, "c").expires_at is None
        assert tile_records.done(connection, "j") == [0]
        assert uploads.by_key(connection, "again") == uploads.get(connection, "u")
        assert uploads.parts_of(connection, "u") == [Part("a", 1), Part("b", 2)]
        assert idempotency.find(connection, "again", "POST") == "c"
        assert programs.add(connection, {"new": 1}) != "p"
    with pytest.raises(IntegrityError), writing(for_owner(engine, DEFAULT)) as connection:
        idempotency.add(connection, "again", "POST", "d")
    with pytest.raises(IntegrityError), writing(for_owner(engine, DEFAULT)) as connection:
        uploads.add(connection, "v", 1, "", 1, "again")
    with writing(for_owner(engine, "alice")) as connection:
        for get, id in ((captures.get, "c"), (mattes.get, "m"), (programs.get, "p"), (jobs.get, "j")):
            with pytest.raises(NotFound):
                get(connection, id)
        assert uploads.by_key(connection, "again") is None
        assert uploads.parts_of(connection, "u") == []
        assert tile_records.done(connection, "j") == []
        assert idempotency.find(connection, "again", "POST") is None
        idempotency.add(connection, "again", "POST", "d")
        uploads.add(connection, "v", 1, "", 1, "again")
        assert programs.get(connection, programs.add(connection, {"new": 1})).owner == "alice"
    with reading(engine) as connection:
        assert differences(connection) == []
    engine.dispose()


def test_mattes_before_names_are_named_after_their_captures(bare: Engine) -> None:
    with writing(bare) as connection:
        migrations.upgrade(connection, "0010")
        for statement in (
            "INSERT INTO captures (id, name, state, job, bytes, frames, program, created_at) "
            "VALUES ('c', 'ball', 'ready', 'j', 5, 4, '{}', 1000.5)",
            "INSERT INTO mattes (id, capture, job, state, options, created_at) "
            "VALUES ('m', 'c', 'j', 'ready', '{}', 1000.5)",
            "INSERT INTO mattes (id, capture, job, state, options, created_at) "
            "VALUES ('of a deleted capture', 'd', 'j', 'ready', '{}', 1000.5)",
            "INSERT INTO mattes (id, state, options, created_at) VALUES ('imported', 'ready', '{}', 1000.5)",
        ):
            connection.exec_driver_sql(statement)
    engine = open_engine(bare.url.render_as_string(hide_password=False))
    with reading(engine) as connection:
        names = {id: mattes.get(connection, id).name for id in ("m", "of a deleted capture", "imported")}
    assert names == {"m": "ball", "of a deleted capture": "", "imported": ""}
    engine.dispose()


def test_programs_before_their_sizes_are_counted(bare: Engine) -> None:
    program = {"parts": ["x" * 1000]}
    with writing(bare) as connection:
        migrations.upgrade(connection, "0013")
        connection.execute(
            text("INSERT INTO programs (id, program, created_at) VALUES ('p', :program, 1000.5)"),
            {"program": json.dumps(program)},
        )
    engine = open_engine(bare.url.render_as_string(hide_password=False))
    with reading(engine) as connection:
        assert programs.get(connection, "p").row_bytes == json_bytes(program)
        assert stored_bytes(connection) == json_bytes(program)
    engine.dispose()
