"""The ledger: jobs, their tiles and their log. The one truth about progress.

A job is ``queued``, ``running``, and then one of ``succeeded``, ``failed`` and ``cancelled``. Its work is cut into
tiles (frames of a capture by slabs, pixels of a matte by rectangles), each ``queued``, ``done`` or ``failed``; a tile
is done when what it writes is stored and its row here says so.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import Connection, Row, delete, insert, or_, select, update

from storage.database import captures, coordinator, find, jobs, log, made, mattes, new_id, tiles
from storage.errors import Conflict

ACTIVE = ("queued", "running")


def add(
    connection: Connection, kind: str, capture: str, options: dict[str, Any], matte: str | None = None
) -> str:
    """Queue a job; returns its id."""
    job = new_id()
    row = {
        "id": job,
        "kind": kind,
        "state": "queued",
        "stage": "waiting",
        "capture": capture,
        "matte": matte,
        "options": options,
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
    """Jobs that were cancelled, and that have left something: a matte, or a capture, in the making."""
    query = (
        select(jobs)
        .outerjoin(mattes, mattes.c.id == jobs.c.matte)
        .outerjoin(captures, captures.c.job == jobs.c.id)
        .where(
            jobs.c.state == "cancelled", or_(mattes.c.state == "recovering", captures.c.state == "ingesting")
        )
    )
    return connection.execute(query).all()


def enter(connection: Connection, job: str, stage: str) -> None:
    """Put an active job into a stage; the first one starts it."""
    row = get(connection, job)
    if row.state not in ACTIVE:
        return
    started = row.started_at or time.time()
    values = {"state": "running", "stage": stage, "started_at": started}
    connection.execute(update(jobs).where(jobs.c.id == job).values(values))
    note(connection, job, stage)


def lay_down(connection: Connection, job: str, plan: dict[str, Any]) -> None:
    """Write down a job's plan and its tiles, once: a repeat changes nothing."""
    if get(connection, job).plan is not None:
        return
    rows = [{"job": job, "tile": tile, "state": "queued", "attempts": 0} for tile in range(plan["tiles"])]
    connection.execute(insert(tiles), rows)
    connection.execute(update(jobs).where(jobs.c.id == job).values(plan=plan, total=plan["tiles"]))


def to_do(connection: Connection, job: str) -> list[int]:
    """The tiles of a job that are still to do, ascending."""
    query = select(tiles.c.tile).where(tiles.c.job == job, tiles.c.state == "queued").order_by(tiles.c.tile)
    return list(connection.scalars(query))


def finish_tiles(connection: Connection, job: str, finished: Iterable[tuple[int, float, int]]) -> None:
    """Write down finished tiles, each (tile, seconds, pixels); one that was done before counts once."""
    done = pixels = 0
    for tile, seconds, size in finished:
        result = connection.execute(
            update(tiles)
            .where(tiles.c.job == job, tiles.c.tile == tile, tiles.c.state == "queued")
            .values(state="done", seconds=seconds, attempts=tiles.c.attempts + 1)
        )
        done += result.rowcount
        pixels += size * result.rowcount
    connection.execute(
        update(jobs).where(jobs.c.id == job).values(done=jobs.c.done + done, pixels=jobs.c.pixels + pixels)
    )


def miss_tile(connection: Connection, job: str, tile: int, reason: str, allowed: int) -> bool:
    """Write down a failed attempt at a tile; true if it may be tried again, which one that is done need not be."""
    here = (tiles.c.job == job, tiles.c.tile == tile, tiles.c.state == "queued")
    if not connection.execute(update(tiles).where(*here).values(attempts=tiles.c.attempts + 1)).rowcount:
        return False
    attempts = connection.scalar(select(tiles.c.attempts).where(*here)) or 0
    note(connection, job, f"tile {tile}, attempt {attempts} of {allowed}: {reason}")
    if attempts < allowed:
        return True
    connection.execute(update(tiles).where(*here).values(state="failed"))
    connection.execute(update(jobs).where(jobs.c.id == job).values(failed=jobs.c.failed + 1))
    return False


def end(connection: Connection, job: str, state: str, problem: dict[str, Any] | None = None) -> bool:
    """End an active job; false, and nothing changed, if it had ended before."""
    result = connection.execute(
        update(jobs)
        .where(jobs.c.id == job, jobs.c.state.in_(ACTIVE))
        .values(state=state, stage=state, problem=problem, finished_at=time.time())
    )
    if result.rowcount:
        note(connection, job, f"{state}: {problem['detail']}" if problem else state)
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


def retry(connection: Connection, job: str) -> None:
    """Queue a failed job again; the tiles that are done stay done.

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
    connection.execute(
        update(tiles).where(tiles.c.job == job, tiles.c.state != "done").values(state="queued", attempts=0)
    )
    values = {"state": "queued", "stage": "waiting", "failed": 0, "problem": None, "finished_at": None}
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


def beat(connection: Connection, workers: int, threads: int) -> None:
    """Write down that the coordinator lives, and the cluster that it sees."""
    values = {"beat_at": time.time(), "workers": workers, "threads": threads}
    if not connection.execute(update(coordinator).values(values)).rowcount:
        connection.execute(insert(coordinator).values(id=1, **values))


def last_beat(connection: Connection) -> Row[Any] | None:
    """The coordinator's last sign of life, if there ever was one."""
    return connection.execute(select(coordinator)).one_or_none()
