"""A job with tiles, and the texts of its log, for the tests of records."""

from sqlalchemy import Connection

from storage.records import jobs, tiles


def planned(connection: Connection, count: int = 3) -> str:
    """A queued recovery with some tiles; returns its id."""
    job = jobs.add(connection, "recover", "cap", {"method": "lobes"}, matte="mat")
    tiles.add_plan(connection, job, {"tiles": count, "slab": 9})
    return job


def log_of(connection: Connection, job: str) -> list[str]:
    """The lines of a job's log."""
    return [row.text for row in jobs.log_lines(connection, job, 0, 100)]
