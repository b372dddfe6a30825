"""Backing up an installation that changes meanwhile, or is damaged."""

import gc
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine, delete, event, select

from storage.database import dialects
from storage.database import tables as database_tables
from storage.database.engine import reading, writing
from storage.errors import Corrupt, Unavailable
from storage.layout import composites
from storage.maintenance.backup import back_up
from storage.maintenance.restore import restore
from storage.maintenance.verify import verify
from storage.objects.store import Objects
from storage.records import captures, jobs, links, mattes
from tests.parts.postgres import Server
from tests.storage.installation import flip


def test_backup_while_items_are_deleted_and_finished(
    engine: Engine, filled: Objects, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    """Every family except the first has changed before it is copied."""
    first: list[str] = []

    def meanwhile(share: float, size: int) -> None:
        if first:
            return
        first.extend(target.names("objects"))
        with writing(engine) as c:
            jobs.cancel(c, "rr")
            mattes.delete(c, "m")
            mattes.delete(c, "r")
            captures.change(c, "i", state="ready")
            jobs.end(c, "ii", "succeeded")
            for job in ("v", "w"):
                c.execute(delete(database_tables.jobs).where(database_tables.jobs.c.id == job))
        for path in ("mattes/m", "mattes/r", "uploads/i", "composites/v", "composites/w"):
            filled.delete(path)
        for path in [path for path in filled.sizes("captures/c")]:
            filled.write_raw(path.replace("/c/", "/i/", 1), iter([filled.read_raw(path)]))

    back_up(engine, filled, target, "1", meanwhile)
    restore(target, *elsewhere)
    assert verify(*elsewhere).findings == []
    with reading(elsewhere[0]) as c:
        found = dict(c.execute(select(database_tables.captures.c.id, database_tables.captures.c.state)).all())
        assert found["c"] == "ready"
        assert set(c.scalars(select(database_tables.mattes.c.id))) in ({"l"}, {"l", "m", "r"})
        for row in [jobs.get(c, one.id) for one in jobs.to_run(c)]:  # jobs that continue have what they need
            if row.kind == "recover":
                assert mattes.get(c, row.matte).state == "recovering"
                assert f"mattes/{row.matte}/zarr.json" in elsewhere[1].sizes(f"mattes/{row.matte}")
            if row.kind == "composite":
                assert composites.clip_path(row.id) in elsewhere[1].sizes(composites.path(row.id))
        if found["i"] == "ready":
            assert jobs.get(c, "ii").state == "succeeded"


def test_links_of_a_family_that_changes_meanwhile_are_restored(
    engine: Engine, filled: Objects, target: Objects, elsewhere: tuple[Engine, Objects]
) -> None:
    def meanwhile(share: float, size: int) -> None:
        with writing(engine) as c:
            if jobs.active_job(c, matte="r") is None:
                return
            jobs.cancel(c, "rr")
            mattes.delete(c, "r")
        filled.delete("mattes/r")

    back_up(engine, filled, target, "1", meanwhile)
    restore(target, *elsewhere)
    with reading(elsewhere[0]) as c:
        assert set(c.scalars(select(database_tables.mattes.c.id))) == {"l", "m"}
        assert len(links.list_all(c, "m")) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings(  # SQLAlchemy can't close the cursor of a connection that broke
    "ignore:.*ServerCursor:pytest.PytestUnraisableExceptionWarning"
)
@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
def test_restarted_database_fails_or_finishes_a_backup_and_a_restore(
    engine: Engine,
    filled: Objects,
    target: Objects,
    postgresql_server: Server,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def restart_at(engine: Engine, statement: str) -> None:
        """Restart the server after a statement, within its transaction."""

        def restart(connection: Any, cursor: Any, sql: str, *more: Any) -> None:
            if sql.startswith(statement):
                event.remove(engine, "after_cursor_execute", restart)
                postgresql_server.restart()

        event.listen(engine, "after_cursor_execute", restart)

    def restart_once(share: float, size: int) -> None:
        if not restarts:
            restarts.append(share)
            postgresql_server.restart()

    def refuse(act: Callable[[], object]) -> None:
        with pytest.raises(Unavailable):
            act()

    store = Objects((tmp_path / "elsewhere").as_uri())
    restart_at(engine, "SELECT captures")
    caplog.set_level(logging.CRITICAL, "sqlalchemy.pool")  # what it logs would keep the cursor
    refuse(lambda: back_up(engine, filled, target, "1"))
    gc.collect()  # the cursor, here and not in a later test
    assert target.names("") == []
    restarts: list[float] = []
    made = back_up(engine, filled, target, "1", restart_once)  # between two transactions
    with postgresql_server.database() as url:
        other = dialects.make_engine(url)
        restart_at(other, "INSERT INTO jobs")
        refuse(lambda: restore(target, other, store))
        assert store.names("") == []
        restarts.clear()
        assert restore(target, other, store, restart_once) == made
        assert verify(other, store).findings == []
        other.dispose()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["flipped", "gone"])
def test_damaged_object_fails_backup(engine: Engine, filled: Objects, target: Objects, how: str) -> None:
    path = "mattes/m/S/c/1/2/0"
    flip(filled, path) if how == "flipped" else filled.delete(path)
    with pytest.raises(
        Corrupt, match=rf"{path} is (damaged|missing) .*recover, or import, it again.*envmatte verify"
    ):
        back_up(engine, filled, target, "1")
    assert target.names("") == []
