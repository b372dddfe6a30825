"""The ledger: jobs, their tiles and their log. The one truth about progress.

A job is ``queued``, ``running``, and then one of ``succeeded``, ``failed`` and ``cancelled``. Its work is cut into
tiles (frames of a capture by slabs, pixels of a matte by rectangles), each ``queued``, ``done`` or ``failed``; a tile
is done when what it writes is stored and its row here says so. One that is done here, and then not to be found in the
store, is ``missing`` until it is done again.
"""

import time
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Column, Connection, Row, bindparam, delete, exists, func, insert, or_, select, update

from storage import deliveries
from storage.database import captures, find, jobs, log, made, mattes, new_id, tiles, totals
from storage.errors import Conflict

ACTIVE = ("queued", "running")
TO_DO = ("queued", "missing")
PREPARE, FINISH = -2, -1
"""The steps before and after a job's tiles: tiles too, of which nobody counts the pixels."""


def add(
    connection: Connection,
    kind: str,
    capture: str,
    options: dict[str, Any],
    matte: str | None = None,
    trace: str | None = None,
    job: str | None = None,
    stored: int | None = None,
    webhook: str | None = None,
) -> str:
    """Queue a job; returns its id.

    Parameters
    ----------
    job : str, optional
        The id, if it has one already: something was stored under it.
    stored : int, optional
        How many bytes that is.
    trace : str, optional
        The ``traceparent`` (W3C Trace Context) of the request that asks for it.
    webhook : str, optional
        URL that is told whenever it has ended.
    """
    job = job or new_id()
    row = {
        "id": job,
        "kind": kind,
        "state": "queued",
        "stage": "waiting",
        "capture": capture,
        "matte": matte,
        "options": options,
        "trace": trace,
        "stored": stored,
        "webhook": webhook,
        "created_at": time.time(),
    }
    connection.execute(insert(jobs).values(row))
    note(connection, job, "queued")
    return job


def get(connection: Connection, job: str) -> Row[Any]:
    """A job's row; `NotFound` if there is none."""
    return find(connection, jobs, job)


def active(connection: Connection) -> Sequence[Row[Any]]:
    """Jobs that are queued or running, oldest first."""
    query = select(jobs).where(jobs.c.state.in_(ACTIVE)).order_by(jobs.c.number)
    return connection.execute(query).all()


def not_wound_up(connection: Connection) -> Sequence[Row[Any]]:
    """Jobs that were cancelled, and that have left something: a matte, or a capture, in the making, or a composite."""
    # A composite has no other record: what it left is there for as long as its tiles are, see `clear`.
    left = (jobs.c.kind == "composite") & exists().where(tiles.c.job == jobs.c.id)
    query = (
        select(jobs)
        .outerjoin(mattes, mattes.c.job == jobs.c.id)
        .outerjoin(captures, captures.c.job == jobs.c.id)
        .where(
            jobs.c.state == "cancelled",
            or_(mattes.c.state == "recovering", captures.c.state == "ingesting", left),
        )
    )
    return connection.execute(query).all()


def clear(connection: Connection, job: str) -> None:
    """Delete the tiles of a job that was cancelled; what is known of it as a whole stays."""
    connection.execute(delete(tiles).where(tiles.c.job == job))


def begin(connection: Connection, job: str) -> None:
    """Write down the two steps around a job's tiles, once: a repeat changes nothing."""
    known = set(connection.scalars(select(tiles.c.tile).where(tiles.c.job == job, tiles.c.tile < 0)))
    rows = [_tile(job, step) for step in (PREPARE, FINISH) if step not in known]
    if rows:
        connection.execute(insert(tiles), rows)


def change(connection: Connection, job: str, **values: Any) -> None:
    """Change a job's row."""
    connection.execute(update(jobs).where(jobs.c.id == job).values(values))


def enter(connection: Connection, job: str, stage: str) -> None:
    """Put an active job into a stage; the first one starts it."""
    row = get(connection, job)
    if row.state not in ACTIVE:
        return
    now = time.time()
    values = {"state": "running", "stage": stage, "started_at": row.started_at or now, "stage_at": now}
    values |= {"moved_at": now, "paced_at": None}
    connection.execute(update(jobs).where(jobs.c.id == job).values(values))
    note(connection, job, stage)


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


def name_of(tile: int) -> str:
    """What people call a tile, or a step around them."""
    return {PREPARE: "preparing", FINISH: "finishing"}.get(tile, f"tile {tile}")


def _count(connection: Connection, job: str, **more: float) -> None:
    """Add to what was ever done by jobs of a kind."""
    kind = get(connection, job).kind
    values = {totals.c[name]: totals.c[name] + value for name, value in more.items()}
    if not connection.execute(update(totals).where(totals.c.kind == kind).values(values)).rowcount:
        none = {"tiles": 0, "misses": 0, "losses": 0, "pixels": 0, "seconds": 0.0}
        connection.execute(insert(totals).values(kind=kind, **(none | more)))


def end(connection: Connection, job: str, state: str, problem: dict[str, Any] | None = None) -> bool:
    """End an active job; false, and nothing changed, if it had ended before."""
    result = connection.execute(
        update(jobs)
        .where(jobs.c.id == job, jobs.c.state.in_(ACTIVE))
        .values(state=state, stage=state, problem=problem, finished_at=time.time())
    )
    if result.rowcount:
        note(connection, job, f"{state}: {problem['detail']}" if problem else state)
        row = get(connection, job)
        if row.webhook:
            deliveries.add(connection, row)
    return bool(result.rowcount)


def cancel(connection: Connection, job: str) -> None:
    """Cancel an active job; a cancelled one stays so.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it has ended otherwise.
    """
    row = get(connection, job)
    if not end(connection, job, "cancelled") and row.state != "cancelled":
        raise Conflict(f"job {job} has {row.state} already and can't be cancelled")


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


def forget(connection: Connection, job: str) -> None:
    """Delete a job that has ended, its tiles and its log.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it is active.
    """
    row = get(connection, job)
    if row.state in ACTIVE:
        raise Conflict(f"job {job} is {row.state}; cancel it first")
    connection.execute(delete(jobs).where(jobs.c.id == job))


def note(connection: Connection, job: str, text: str) -> None:
    """Add a line to a job's log."""
    connection.execute(insert(log).values(job=job, at=time.time(), text=text))


def notes(connection: Connection, job: str, after: int, limit: int) -> Sequence[Row[Any]]:
    """Lines of a job's log after a line, oldest first."""
    query = select(log).where(log.c.job == job, log.c.line > after).order_by(log.c.line).limit(limit)
    return connection.execute(query).all()


def made_by(connection: Connection, key: str, call: str) -> str | None:
    """The id of what a call with this Idempotency-Key made, if it made something."""
    return connection.scalar(select(made.c.id).where(made.c.key == key, made.c.call == call))


def remember(connection: Connection, key: str, call: str, made_id: str) -> None:
    """Write down what a call with an Idempotency-Key made."""
    connection.execute(insert(made).values(key=key, call=call, id=made_id))
