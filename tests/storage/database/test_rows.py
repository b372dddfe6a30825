"""Ids, and pages of rows."""

import pytest
from sqlalchemy import Connection

from storage.database import rows, tables
from storage.errors import NotFound
from storage.records import captures, jobs
from tests.storage.planned import planned


def test_ids_are_opaque_and_unique() -> None:
    ids = {rows.new_id() for _ in range(1000)}
    assert len(ids) == 1000
    assert all(name.isalnum() and len(name) == 20 for name in ids)


def test_page_is_newest_first(connection: Connection) -> None:
    made = [planned(connection) for _ in range(5)]
    for job in (made[1], made[3]):
        jobs.end(connection, job, "failed")

    def ids(limit: int, after: str | None, **equal: str | None) -> list[str]:
        return [row.id for row in rows.page(connection, tables.jobs, limit, after, **equal)]

    assert ids(10, None) == made[::-1]
    assert ids(2, None) == [made[4], made[3]]
    assert ids(2, made[3]) == [made[2], made[1]]
    assert ids(2, made[0]) == []
    assert ids(10, None, state="failed", kind=None) == [made[3], made[1]]
    assert ids(10, made[2], state="failed") == [made[1]]
    assert ids(10, made[2], state="queued", kind="recover") == [made[0]]
    assert ids(10, None, kind="ingest") == []
    with pytest.raises(NotFound) as caught:
        ids(10, "none")
    assert caught.value.fields == {"field": "after"}


def test_page_has_rows_whose_names_match(connection: Connection) -> None:
    for number, name in enumerate(("Whisky glass", "100% glass", "ball")):
        captures.add(connection, str(number), "j", name=name, bytes=1, frames=1, program={})

    def ids(name: str | None) -> list[str]:
        return [row.id for row in rows.page(connection, tables.captures, 10, None, name=name)]

    assert ids("glass") == ["1", "0"]
    assert ids("WHISKY") == ["0"]
    assert ids("%") == ["1"]  # no wildcard
    assert ids("") == ids(None) == ["2", "1", "0"]
