"""Rows of a job's tiles: which are to do, done, failed or missing, and how often each was tried.

A tile is a slab of a capture's frames, a rectangle of a matte's pixels, or a segment of a clip; the two steps around
the tiles (`storage.steps`) have rows too. A tile is ``queued``, and ``done`` once its output is stored and its row says
so; it is ``failed`` after too many attempts. A done tile whose output is not in the store any more is ``missing`` until
it is done again.
"""

import time
from collections.abc import Sequence
from typing import Any, Literal

from sqlalchemy import Column, Connection, bindparam, insert, select, update

from storage.database.rows import json_bytes
from storage.database.tables import jobs, tiles, totals
from storage.records.jobs import get, log
from storage.steps import FINISH, PREPARE, step_name

State = Literal["queued", "done", "missing", "failed"]
REMAINING = ("queued", "missing")


def add_steps(connection: Connection, job: str) -> None:
    """Add the two steps around a job's tiles; a repeated call changes nothing."""
    known = set(connection.scalars(select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile < 0)))
    rows = [_tile(job, step) for step in (PREPARE, FINISH) if step not in known]
    if rows:
        connection.execute(insert(tiles), rows)


def add_plan(connection: Connection, job: str, plan: dict[str, Any]) -> None:
    """Store a job's plan and add its tiles; a repeated call changes nothing."""
    if get(connection, job).plan is not None:
        return
    connection.execute(insert(tiles), [_tile(job, tile) for tile in range(plan["tiles"])])
    connection.execute(
        update(jobs)
        .where(jobs.c.id == job)
        .values(plan=plan, total=plan["tiles"], row_bytes=jobs.c.row_bytes + json_bytes(plan))
    )


def _tile(job: str, tile: int) -> dict[str, Any]:
    return {"job": job, "tile": tile, "state": "queued", "attempts": 0, "losses": 0}


def remaining(connection: Connection, job: str) -> list[int]:
    """The tiles of a job that are still to be done, ascending."""
    query = select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile >= 0, tiles.c.state.in_(REMAINING))
    return list(connection.scalars(query.order_by(tiles.c.tile)))


def done(connection: Connection, job: str) -> list[int]:
    """The tiles of a job that are done, ascending."""
    query = select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile >= 0, tiles.c.state == "done")
    return list(connection.scalars(query.order_by(tiles.c.tile)))


def mark_done(connection: Connection, job: str, finished: Sequence[tuple[int, float, int]]) -> None:
    """Mark tiles as done, each given as (tile, seconds, pixels); a tile that was already done counts once."""
    query = select(tiles.c.tile, tiles.c.state).where(
        tiles.c.job == job, tiles.c.tile.in_([tile for tile, _, _ in finished]), tiles.c.state.in_(REMAINING)
    )
    states = {tile: state for tile, state in connection.execute(query)}
    ended = {tile: (seconds, pixels) for tile, seconds, pixels in finished if tile in states}
    if not ended:
        return
    connection.execute(
        update(tiles)
        .where(tiles.c.job == job, tiles.c.tile == bindparam("which"))
        .values(state="done", seconds=bindparam("took")),
        [{"which": tile, "took": seconds} for tile, (seconds, _) in ended.items()],
    )
    new = [tile for tile in ended if tile >= 0 and states[tile] == "queued"]
    pixels = sum(ended[tile][1] for tile in new)
    connection.execute(
        update(jobs)
        .where(jobs.c.id == job)
        .values(done=jobs.c.done + len(new), pixels=jobs.c.pixels + pixels, moved_at=time.time())
    )
    seconds = sum(took for tile, (took, _) in ended.items() if tile >= 0)
    _count(connection, job, tiles=len(new), pixels=pixels, seconds=seconds)


def start_pace(connection: Connection, job: str, after: int) -> bool:
    """Measure the pace of a job's tiles from now on; false, without a change, if fewer than `after` are done."""
    values = {"paced_at": time.time(), "paced_done": jobs.c.done}
    result = connection.execute(update(jobs).where(jobs.c.id == job, jobs.c.done >= after).values(values))
    return bool(result.rowcount)


def record_failure(connection: Connection, job: str, tile: int, reason: str, allowed: int) -> bool:
    """Record a failed attempt at a tile; returns whether to try it again, which is false for a done tile."""
    return _record(connection, job, tile, tiles.c.attempts, "attempt", reason, allowed)


def record_loss(connection: Connection, job: str, tile: int, reason: str, allowed: int) -> bool:
    """Record that a tile was lost, for example with its worker; returns whether to try it again."""
    return _record(connection, job, tile, tiles.c.losses, "loss", reason, allowed)


def _record(
    connection: Connection, job: str, tile: int, counter: Column[int], what: str, reason: str, allowed: int
) -> bool:
    here = (tiles.c.job == job, tiles.c.tile == tile, tiles.c.state.in_(REMAINING))
    if not connection.execute(update(tiles).where(*here).values({counter: counter + 1})).rowcount:
        return False
    count = connection.scalar(select(counter).where(*here)) or 0
    log(connection, job, f"{step_name(tile)}, {what} {count} of {allowed}: {reason}")
    _count(connection, job, **{"misses" if what == "attempt" else "losses": 1})
    if count < allowed:
        return True
    connection.execute(update(tiles).where(*here).values(state="failed"))
    if tile >= 0:
        connection.execute(update(jobs).where(jobs.c.id == job).values(failed=jobs.c.failed + 1))
    return False


def requeue_missing(connection: Connection, job: str, missing: Sequence[int], allowed: int) -> list[int]:
    """Queue done tiles again whose output is not in the store; returns those that may be tried again."""
    connection.execute(
        update(tiles)
        .where(tiles.c.job == job, tiles.c.tile.in_(missing), tiles.c.state == "done")
        .values(state="missing")
    )
    return [
        tile
        for tile in missing
        if record_loss(connection, job, tile, "its output is missing in the store", allowed)
    ]


def _count(connection: Connection, job: str, **more: float) -> None:
    """Add to the totals of the job's kind."""
    kind = get(connection, job).kind
    values = {totals.c[name]: totals.c[name] + value for name, value in more.items()}
    if not connection.execute(update(totals).where(totals.c.kind == kind).values(values)).rowcount:
        none = {"tiles": 0, "misses": 0, "losses": 0, "pixels": 0, "seconds": 0.0}
        connection.execute(insert(totals).values(kind=kind, **(none | more)))
