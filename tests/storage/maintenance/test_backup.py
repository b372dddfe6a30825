"""Backing up an installation that changes meanwhile, or is damaged."""

import pytest
from sqlalchemy import Engine, delete, select

from storage.database import tables as database_tables
from storage.database.engine import reading, writing
from storage.errors import Corrupt
from storage.layout import composites
from storage.maintenance.backup import back_up
from storage.maintenance.restore import restore
from storage.maintenance.verify import verify
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
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
        for row in jobs.active(c):  # jobs that continue have what they need
            if row.kind == "recover":
                assert mattes.get(c, row.matte).state == "recovering"
                assert f"mattes/{row.matte}/zarr.json" in elsewhere[1].sizes(f"mattes/{row.matte}")
            if row.kind == "composite":
                assert composites.clip_path(row.id) in elsewhere[1].sizes(composites.path(row.id))
        if found["i"] == "ready":
            assert jobs.get(c, "ii").state == "succeeded"


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
