"""Sums and searches that stay quick in a database with very many rows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, event

from storage import statistics
from storage.database.engine import open_engine, reading
from storage.database.owners import for_owner
from storage.database.rows import page
from storage.database.tables import captures, mattes
from storage.database.tables import jobs as table
from storage.maintenance import inventory
from storage.records import jobs

MANY = ("captures", "mattes", "jobs", "tiles", "log", "programs")
"""Tables that grow with all that a service has done."""

QUERIES: dict[str, Callable[[Connection], Any]] = {
    "jobs by kind": statistics.job_counts,
    "missing tiles": statistics.missing_tiles,
    "captures by state": statistics.capture_counts,
    "mattes by state": statistics.matte_counts,
    "tiles a second": statistics.tiles_per_second,
    "active jobs": statistics.active_jobs,
    "bytes of an owner": statistics.stored_bytes,
    "bytes of all": lambda c: statistics.stored_bytes(c, all_owners=True),
    "recent ingests": lambda c: statistics.recent_ingests(c, 16),
    "jobs to run": jobs.to_run,
    "active job of a capture": lambda c: jobs.active_job(c, capture="c"),
    "cancelled jobs": jobs.cancelled_with_leftovers,
    "a page of captures": lambda c: list(page(c, captures, 100, None)),
    "a page of mattes": lambda c: list(page(c, mattes, 100, None)),
    "a page of jobs": lambda c: list(page(c, table, 100, None)),
    "a page of failed jobs": lambda c: list(page(c, table, 100, None, state="failed")),
    "known captures": lambda c: inventory.known_names(c, "captures", ["a", "b"]),
    "known composites": lambda c: inventory.known_names(c, "composites", ["a", "b"]),
}


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        (name, owner)
        for name in QUERIES
        for owner in ("somebody", None)
        # Without an owner, the newest rows are the last of a table.
        if (name != "jobs to run" if owner else not ("page" in name or name == "recent ingests"))
    ],
)
def test_no_query_reads_or_sorts_all_rows(name: str, owner: str | None, tmp_path: Path) -> None:
    """Sums may go through an index that has all they need."""
    engine = open_engine(f"sqlite:///{tmp_path}/some.db")
    seen: list[tuple[str, Any]] = []
    event.listen(
        engine, "before_cursor_execute", lambda c, cursor, sql, values, *_: seen.append((sql, values))
    )
    with reading(for_owner(engine, owner) if owner else engine) as c:
        QUERIES[name](c)
        steps = [
            row[-1]
            for sql, values in seen
            if sql.startswith("SELECT")
            for row in c.connection.execute(f"EXPLAIN QUERY PLAN {sql}", values)
        ]
    assert steps
    slow = [
        step
        for step in steps
        if (step.startswith(tuple(f"SCAN {many}" for many in MANY)) and "COVERING INDEX" not in step)
        or ("page" in name and "ORDER BY" in step)
    ]
    assert slow == []
    engine.dispose()


def test_mattes_of_a_capture_are_found_without_the_owners_others(tmp_path: Path) -> None:
    engine = open_engine(f"sqlite:///{tmp_path}/some.db")
    seen: list[tuple[str, Any]] = []
    with reading(for_owner(engine, "somebody")) as c:
        event.listen(
            engine, "before_cursor_execute", lambda c, cursor, sql, values, *_: seen.append((sql, values))
        )
        list(page(c, mattes, 100, None, capture="c"))
        sql, values = seen[-1]
        ((*_, step),) = c.connection.execute(f"EXPLAIN QUERY PLAN {sql}", values)
    assert "mattes_by_capture" in step
    engine.dispose()
