"""Rows of mattes."""

import pytest
from sqlalchemy import Engine

from storage.database.engine import writing
from storage.errors import NotFound
from storage.records import mattes


def test_imported_matte_expires_too(engine: Engine) -> None:
    with writing(engine) as connection:
        mattes.add_imported(connection, "m", {}, {}, seconds=60)
        row = mattes.get_ready(connection, "m")
        assert row.expires_at == row.created_at + 60


def test_rows_are_added_changed_and_deleted(engine: Engine) -> None:
    with writing(engine) as connection:
        mattes.add(connection, "m1", "c1", "j1", {"method": "lobes"})
        mattes.add(connection, "m2", "c1", "j2", {})
        row = mattes.get(connection, "m1")
        assert (row.state, row.capture, row.job, row.options) == (
            "recovering",
            "c1",
            "j1",
            {"method": "lobes"},
        )
        mattes.change(connection, "m1", state="ready", figures={"block": 16})
    with writing(engine) as connection:
        assert mattes.get(connection, "m1").figures == {"block": 16}
        assert mattes.get(connection, "m2").figures is None
        mattes.delete(connection, "m1")
        with pytest.raises(NotFound, match="'m1'"):
            mattes.get(connection, "m1")
        assert mattes.get(connection, "m2").state == "recovering"
