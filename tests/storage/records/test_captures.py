"""Rows of captures."""

import json

import pytest
from sqlalchemy import Engine

from storage.database.engine import writing
from storage.errors import NotFound
from storage.records import captures


def test_rows_are_added_changed_and_deleted(engine: Engine) -> None:
    with writing(engine) as connection:
        captures.add(connection, "c1", "j1", name="ball", bytes=7, frames=3, program={"parts": []})
        captures.add(connection, "c2", "j2", name="", bytes=8, frames=4, program={})
        row = captures.get(connection, "c1")
        assert (row.state, row.job, row.name, row.bytes, row.frames) == ("ingesting", "j1", "ball", 7, 3)
        assert (row.width, row.problem) == (None, None)
        assert json.loads(captures.program_json(connection, "c1")) == {"parts": []}
        captures.change(connection, "c1", state="ready", width=20, height=10)
    with writing(engine) as connection:
        row = captures.get(connection, "c1")
        assert (row.state, row.width, row.height) == ("ready", 20, 10)
        assert captures.get(connection, "c2").state == "ingesting"
        captures.delete(connection, "c1")
        with pytest.raises(NotFound, match="'c1'"):
            captures.get(connection, "c1")
        assert captures.get(connection, "c2").job == "j2"
