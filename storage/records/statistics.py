"""Counts and sums for metrics, limits and estimates; none of them reads all tiles."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, Text, cast, func, select

from storage.database.owners import across_owners
from storage.database.tables import captures, jobs, mattes, programs, tiles, totals, uploads
from storage.records.jobs import ACTIVE
from storage.steps import FINISH


def job_counts(connection: Connection) -> Sequence[Row[Any]]:
    """Jobs by ``kind`` and ``state``: their ``number``, and the ``total``, ``done`` and ``failed`` tiles."""
    sums = [func.sum(jobs.c[name]).label(name) for name in ("total", "done", "failed")]
    query = select(jobs.c.kind, jobs.c.state, func.count().label("number"), *sums)
    return connection.execute(query.group_by(jobs.c.kind, jobs.c.state)).all()


def missing_tiles(connection: Connection) -> dict[str, int]:
    """Tiles of active jobs whose output has gone missing in the store and is being made again, by kind of job."""
    query = (
        select(jobs.c.kind, func.count())
        .join(tiles, tiles.c.job == jobs.c.id)
        .where(jobs.c.state.in_(ACTIVE), tiles.c.state == "missing")
        .group_by(jobs.c.kind)
    )
    return {kind: number for kind, number in connection.execute(query)}


def work_totals(connection: Connection) -> Sequence[Row[Any]]:
    """Work done so far by each kind of job, see `storage.database.tables.totals`."""
    return connection.execute(select(totals)).all()


def capture_counts(connection: Connection) -> Sequence[Row[Any]]:
    """Captures by ``state``: their ``number``, and the ``bytes`` of their archives."""
    sums = (func.count().label("number"), func.sum(captures.c.bytes).label("bytes"))
    return connection.execute(select(captures.c.state, *sums).group_by(captures.c.state)).all()


def matte_counts(connection: Connection) -> dict[str, int]:
    """Mattes by state."""
    query = select(mattes.c.state, func.count()).group_by(mattes.c.state)
    return {state: number for state, number in connection.execute(query)}


def upload_counts(connection: Connection) -> Row[Any]:
    """Uploads: their ``number``, the bytes that have ``come``, and their ``length`` in bytes."""
    come, length = (func.coalesce(func.sum(column), 0) for column in (uploads.c.offset, uploads.c.length))
    query = select(func.count().label("number"), come.label("come"), length.label("length"))
    return connection.execute(query.select_from(uploads)).one()


def tiles_per_second(connection: Connection) -> float | None:
    """Tiles per second of all running jobs, each measured over its current stage; None if nothing is measured yet."""
    query = select(jobs.c.done - jobs.c.paced_done, jobs.c.moved_at - jobs.c.paced_at).where(
        jobs.c.state == "running", jobs.c.paced_at < jobs.c.moved_at, jobs.c.done < jobs.c.total
    )
    paces = [done / seconds for done, seconds in connection.execute(query)]
    return sum(paces) if paces else None


def captures_and_uploads(connection: Connection) -> int:
    """The number of captures, and of uploads that may become captures."""
    return sum(connection.scalar(select(func.count()).select_from(one)) or 0 for one in (captures, uploads))


def active_jobs(connection: Connection) -> int:
    """The number of queued and running jobs."""
    return connection.scalar(select(func.count()).where(jobs.c.state.in_(ACTIVE))) or 0


def stored_bytes(connection: Connection, *, all_owners: bool = False) -> int:
    """Bytes stored: as counted for finished data, as announced for uploads.

    Programs count too, although they are only rows: users choose their size, and they do not expire. A capture that is
    being ingested counts with the size of its archive; a matte that is being recovered does not count yet.
    """
    sums = [
        func.sum(func.coalesce(captures.c.stored, captures.c.bytes)),
        func.sum(mattes.c.stored),
        func.sum(jobs.c.stored),
        func.sum(uploads.c.length),
        func.sum(func.length(cast(programs.c.program, Text))),
    ]
    queries = [select(one) for one in sums]
    return sum(
        int(connection.scalar(across_owners(query) if all_owners else query) or 0) for query in queries
    )


def recent_ingests(connection: Connection, limit: int) -> list[tuple[dict[str, Any], float]]:
    """The last ingests that succeeded: the plan of each, and the seconds that its final step took."""
    step = (tiles.c.job == jobs.c.id) & (tiles.c.tile == FINISH)
    query = select(jobs.c.plan, tiles.c.seconds).join(tiles, step)
    query = query.where(jobs.c.kind == "ingest", jobs.c.state == "succeeded", tiles.c.seconds.is_not(None))
    return [
        (plan, took) for plan, took in connection.execute(query.order_by(jobs.c.number.desc()).limit(limit))
    ]
