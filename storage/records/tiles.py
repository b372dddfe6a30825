"""Rows of a job's tiles: queued, done, failed, tried again."""

import time
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Column, Connection, bindparam, delete, func, insert, select, update

from storage.database.tables import jobs, tiles, totals
from storage.errors import Conflict
from storage.records.job_log import note
from storage.records.jobs import get
from storage.steps import FINISH, PREPARE, name_of

TO_DO = ("queued", "missing")


def clear(connection: Connection, job: str) -> None:
    """Delete the tiles of a job that was cancelled; what is known of it as a whole stays."""
    connection.execute(delete(tiles).where(tiles.c.job == job))


def begin(connection: Connection, job: str) -> None:
    """Write down the two steps around a job's tiles, once: a repeat changes nothing."""
    known = set(connection.scalars(select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile < 0)))
    rows = [_tile(job, step) for step in (PREPARE, FINISH) if step not in known]
    if rows:
        connection.execute(insert(tiles), rows)


def lay_down(connection: Connection, job: str, plan: dict[str, Any]) -> None:
    """Write down a job's plan and its tiles, once: a repeat changes nothing."""
    if get(connection, job).plan is not None:
        return
    connection.execute(insert(tiles), [_tile(job, tile) for tile in range(plan["tiles"])])
    connection.execute(update(jobs).where(jobs.c.id == job).values(plan=plan, total=plan["tiles"]))


def _tile(job: str, tile: int) -> dict[str, Any]:
    return {"job": job, "tile": tile, "state": "queued", "attempts": 0, "losses": 0}


def to_do(connection: Connection, job: str) -> list[int]:
    """The tiles of a job that are still to do, ascending."""
    query = select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile >= 0, tiles.c.state.in_(TO_DO))
    return list(connection.scalars(query.order_by(tiles.c.tile)))


def done(connection: Connection, job: str) -> list[int]:
    """The tiles of a job that are done."""
    query = select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile >= 0, tiles.c.state == "done")
    return list(connection.scalars(query.order_by(tiles.c.tile)))


def finish(connection: Connection, job: str, finished: Sequence[tuple[int, float, int]]) -> None:
    """Write down finished tiles, each (tile, seconds, pixels); one that was done before counts once."""
    query = select(tiles.c.tile, tiles.c.state).where(
        tiles.c.job == job, tiles.c.tile.in_([tile for tile, _, _ in finished]), tiles.c.state.in_(TO_DO)
    )
    states = {tile: state for tile, state in connection.execute(query)}
    ended = {tile: (seconds, pixels) for tile, seconds, pixels in finished if tile in states}
    if not ended:
        return
    connection.execute(
        update(tiles)
        .where(tiles.c.job == job, tiles.c.tile == bindparam("which"))
        .values(state="done", seconds=bindparam("took"), attempts=tiles.c.attempts + 1),
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


def pace(connection: Connection, job: str, after: int) -> bool:
    """Measure the pace of a job's tiles from here on; false, and nothing changed, until some are done."""
    values = {"paced_at": time.time(), "paced_done": jobs.c.done}
    result = connection.execute(update(jobs).where(jobs.c.id == job, jobs.c.done >= after).values(values))
    return bool(result.rowcount)


def finished_ingests(connection: Connection, most: int) -> list[tuple[dict[str, Any], float]]:
    """Of the last ingests that succeeded: their plans, and the seconds that the step after their tiles took."""
    step = (tiles.c.job == jobs.c.id) & (tiles.c.tile == FINISH)
    query = select(jobs.c.plan, tiles.c.seconds).join(tiles, step)
    query = query.where(jobs.c.kind == "ingest", jobs.c.state == "succeeded", tiles.c.seconds.is_not(None))
    return [
        (plan, took) for plan, took in connection.execute(query.order_by(jobs.c.number.desc()).limit(most))
    ]


def miss(connection: Connection, job: str, tile: int, reason: str, allowed: int) -> bool:
    """Write down a failed attempt at a tile; true if it may be tried again, which one that is done need not be."""
    return _again(connection, job, tile, tiles.c.attempts, "attempt", reason, allowed)


def lose(connection: Connection, job: str, tile: int, reason: str, allowed: int) -> bool:
    """Write down that a tile was lost, with its worker say; true if it may be tried again, as `miss` says."""
    return _again(connection, job, tile, tiles.c.losses, "loss", reason, allowed)


def _again(
    connection: Connection, job: str, tile: int, counter: Column[int], what: str, reason: str, allowed: int
) -> bool:
    here = (tiles.c.job == job, tiles.c.tile == tile, tiles.c.state.in_(TO_DO))
    if not connection.execute(update(tiles).where(*here).values({counter: counter + 1})).rowcount:
        return False
    count = connection.scalar(select(counter).where(*here)) or 0
    note(connection, job, f"{name_of(tile)}, {what} {count} of {allowed}: {reason}")
    _count(connection, job, **{"misses" if what == "attempt" else "losses": 1})
    if count < allowed:
        return True
    connection.execute(update(tiles).where(*here).values(state="failed"))
    if tile >= 0:
        connection.execute(update(jobs).where(jobs.c.id == job).values(failed=jobs.c.failed + 1))
    return False


def reopen(connection: Connection, job: str, missing: Sequence[int], allowed: int) -> list[int]:
    """Queue tiles again that are done by the ledger, and are not in the store; returns those that may be."""
    connection.execute(
        update(tiles)
        .where(tiles.c.job == job, tiles.c.tile.in_(missing), tiles.c.state == "done")
        .values(state="missing")
    )
    return [tile for tile in missing if lose(connection, job, tile, "it is missing in the store", allowed)]


def _count(connection: Connection, job: str, **more: float) -> None:
    """Add to what was ever done by jobs of a kind."""
    kind = get(connection, job).kind
    values = {totals.c[name]: totals.c[name] + value for name, value in more.items()}
    if not connection.execute(update(totals).where(totals.c.kind == kind).values(values)).rowcount:
        none = {"tiles": 0, "misses": 0, "losses": 0, "pixels": 0, "seconds": 0.0}
        connection.execute(insert(totals).values(kind=kind, **(none | more)))


def retry(connection: Connection, job: str, *, anew: bool = False, trace: str | None = None) -> None:
    """Queue a failed job again; the tiles that are done stay done.

    Parameters
    ----------
    anew : bool
        Forget its plan and its tiles, because the plan would be another one today.
    trace : str, optional
        The ``traceparent`` of the request that asks for it; default that of the one before.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it has not failed.
    """
    row = get(connection, job)
    if row.state != "failed":
        raise Conflict(f"job {job} is {row.state}; only a failed job can be tried again")
    if anew:
        connection.execute(delete(tiles).where(tiles.c.job == job))
        nothing = {"plan": None, "total": 0, "pixels": 0}
        connection.execute(update(jobs).where(jobs.c.id == job).values(nothing))
    connection.execute(
        update(tiles)
        .where(tiles.c.job == job, tiles.c.state != "done")
        .values(state="queued", attempts=0, losses=0)
    )
    done = (tiles.c.job == job, tiles.c.tile >= 0, tiles.c.state == "done")
    values = {"state": "queued", "stage": "waiting", "failed": 0, "problem": None, "finished_at": None}
    values["trace"] = trace or row.trace
    values["done"] = connection.scalar(select(func.count()).where(*done))
    connection.execute(update(jobs).where(jobs.c.id == job).values(values))
    note(connection, job, "queued again")
