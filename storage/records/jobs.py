"""Rows of jobs: their states from queued to ended.

A job is ``queued``, then ``running``, and finally ``succeeded``, ``failed`` or ``cancelled``. The rows of jobs and of
their tiles (`storage.records.tiles`) are the only source of truth about progress: workers and schedulers may restart at
any time.
"""

import time
from collections.abc import Sequence
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, Row, func, insert, select, update

from storage.database.owners import NOBODY
from storage.database.rows import PAUSE, ROW, find, json_bytes, new_id
from storage.database.tables import captures, jobs, mattes, tiles
from storage.database.tables import log as lines
from storage.errors import Conflict
from storage.records import webhook_deliveries

Kind = Literal["ingest", "recover", "composite"]
State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
ACTIVE = ("queued", "running")


def add(
    connection: Connection,
    kind: str,
    capture: str,
    options: dict[str, Any],
    matte: str | None = None,
    *,
    trace: str | None = None,
    job: str | None = None,
    stored: int | None = None,
    webhook: str | None = None,
    region: Sequence[int] | None = None,
) -> str:
    """Queue a job; returns its id.

    Parameters
    ----------
    job : str, optional
        The id, if something is already stored under it; otherwise a new one.
    stored : int, optional
        The bytes stored under the id.
    trace : str, optional
        The ``traceparent`` (W3C Trace Context) of the request.
    webhook : str, optional
        URL to notify when the job has ended.
    region : (x, y, width, height), optional
        The part of the frame that is recovered first, in pixels.
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
        "region": region,
        "created_at": time.time(),
    }
    connection.execute(insert(jobs).values(row))
    log(connection, job, "queued")
    return job


def get(connection: Connection, job: str) -> Row[Any]:
    """A job's row.

    Raises
    ------
    NotFound
        If there is none.
    """
    return find(connection, jobs, job)


def to_run(connection: Connection) -> Sequence[Row[Any]]:
    """Active jobs, oldest first, apart from recoveries that wait for the ingest of their capture.

    Only their ``id``, ``paused`` and ``region``: they may be many, and their plans large.
    """
    ingesting = select(captures.c.id).where(captures.c.state == "ingesting")
    waits = (jobs.c.kind == "recover") & jobs.c.capture.in_(ingesting)
    query = select(*(jobs.c[name] for name in ("id", "paused", "region"))).order_by(jobs.c.number)
    return connection.execute(query.where(jobs.c.state.in_(ACTIVE), ~waits)).all()


def active_job(connection: Connection, **about: str) -> str | None:
    """The oldest active job that uses a ``capture`` or a ``matte``; None if there is none."""
    query = select(jobs.c.id).filter_by(**about).where(is_in_use(*about))
    return connection.scalar(query.order_by(jobs.c.number).limit(1))


def is_in_use(what: str) -> ColumnElement[bool]:
    """The condition that an active job uses its ``capture`` or its ``matte``; a composite uses its matte alone."""
    active = jobs.c.state.in_(ACTIVE)
    return active & (jobs.c.kind != "composite") if what == "capture" else active


def names(connection: Connection, rows: Sequence[Row[Any]]) -> dict[str, str]:
    """The names of what jobs are about, by the jobs' ids: those of their mattes or else of their captures, if any."""
    found: dict[str, str] = {}
    for table, ids in ((captures, {row.capture for row in rows}), (mattes, {row.matte for row in rows})):
        query = select(table.c.id, table.c.name).where(table.c.id.in_(ids))
        found.update((id, name) for id, name in connection.execute(query))
    return {row.id: found.get(row.matte) or found.get(row.capture, "") for row in rows}


def is_retryable(problem: dict[str, Any]) -> bool:
    """Whether a job that failed with a problem may be retried; if so, its input is kept.

    It may unless the input was at fault, which would be refused again.
    """
    return bool(problem["status"] >= 500)


def cancelled_with_leftovers(connection: Connection) -> Sequence[Row[Any]]:
    """Cancelled jobs whose unfinished capture, matte or composite is still to be removed.

    Only what says where that is: they may be many, and their plans large.
    """
    query = select(*(jobs.c[name] for name in ("id", "kind", "capture", "matte")))
    return connection.execute(query.where(jobs.c.state == "cancelled", jobs.c.leftovers)).all()


def change(connection: Connection, job: str, **values: Any) -> None:
    """Change a job's row."""
    connection.execute(update(jobs).where(jobs.c.id == job).values(values))


def enter_stage(connection: Connection, job: str, stage: str) -> bool:
    """Move an active job to a stage; its first stage starts it. Returns false and changes nothing if it has ended."""
    now = time.time()
    started = func.coalesce(jobs.c.started_at, now)
    values = {"state": "running", "stage": stage, "started_at": started, "stage_at": now}
    values |= {"moved_at": now, "paced_at": None}
    result = connection.execute(update(jobs).where(jobs.c.id == job, jobs.c.state.in_(ACTIVE)).values(values))
    if result.rowcount:
        log(connection, job, stage)
    return bool(result.rowcount)


def pause(connection: Connection, job: str, paused: bool) -> None:
    """Pause an active job, or continue it: the tiles under way are done, and no others until it continues.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it has ended.
    """
    row = require_active(connection, job)
    if row.paused != paused:
        # Its pace is measured again: the pause is no part of it.
        values = {"paused": paused, "moved_at": time.time(), "paced_at": None}
        change(connection, job, **values, row_bytes=jobs.c.row_bytes + (PAUSE if paused else 0))
        log(connection, job, "paused" if paused else "continued")


def require_active(connection: Connection, job: str) -> Row[Any]:
    """The row of a job that has not ended.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it has ended.
    """
    row = get(connection, job)
    if row.state not in ACTIVE:
        raise Conflict(f"job {job} has already {row.state}")
    return row


def end(connection: Connection, job: str, state: str, problem: dict[str, Any] | None = None) -> bool:
    """End an active job and queue its webhook; returns false and changes nothing if it has already ended.

    A cancelled job has leftovers until the coordinator has removed what it made.
    """
    values = {"state": state, "stage": state, "problem": problem, "finished_at": time.time(), "paused": False}
    values["leftovers"] = state == "cancelled"
    result = connection.execute(update(jobs).where(jobs.c.id == job, jobs.c.state.in_(ACTIVE)).values(values))
    if result.rowcount:
        log(connection, job, f"{state}: {problem['detail']}" if problem else state)
        row = get(connection, job)
        if row.webhook:
            webhook_deliveries.add(connection, row)
    return bool(result.rowcount)


def cancel(connection: Connection, job: str) -> None:
    """Cancel an active job; cancelling it again changes nothing.

    Raises
    ------
    NotFound
        If there is none.
    Conflict
        If it has succeeded or failed.
    """
    row = get(connection, job)
    if not end(connection, job, "cancelled") and row.state != "cancelled":
        raise Conflict(f"job {job} has already {row.state} and cannot be cancelled")


def retry(connection: Connection, job: str, *, replan: bool = False, trace: str | None = None) -> None:
    """Queue a failed job again; its done tiles stay done. The time since it failed is neither of its queue nor its run.

    Parameters
    ----------
    replan : bool
        Delete its plan and its tiles, because the settings that the plan depends on have changed.
    trace : str, optional
        The ``traceparent`` of the request; by default the job keeps its previous one.

    Raises
    ------
    NotFound
        If there is no such job.
    Conflict
        If it has not failed.
    """
    row = get(connection, job)
    if row.state != "failed":
        raise Conflict(f"job {job} is {row.state}; only a failed job can be retried")
    if replan and row.plan is not None:
        connection.execute(tiles.delete().where(tiles.c.job == job))
        row_bytes = jobs.c.row_bytes - json_bytes(row.plan)
        change(connection, job, plan=None, total=0, pixels=0, row_bytes=row_bytes)
    connection.execute(
        update(tiles)
        .where(tiles.c.job == job, tiles.c.state != "done")
        .values(state="queued", attempts=0, losses=0)
    )
    done = (tiles.c.job == job, tiles.c.tile >= 0, tiles.c.state == "done")
    values = {"state": "queued", "stage": "waiting", "failed": 0, "problem": None, "finished_at": None}
    values |= {"queued_at": time.time(), "started_at": None}
    values["trace"] = trace or row.trace
    values["row_bytes"] = jobs.c.row_bytes + ROW  # the log goes on
    values["done"] = connection.scalar(select(func.count()).where(*done))
    connection.execute(update(jobs).where(jobs.c.id == job).values(values))
    log(connection, job, "queued again")


def delete(connection: Connection, job: str) -> None:
    """Delete a job that has ended, with its tiles and its log.

    A job with leftovers is deleted by `clear_leftovers`; until then it belongs to nobody, so no caller sees it.

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
    if row.leftovers:  # its row tells the coordinator what to remove
        change(connection, job, owner=NOBODY)
    else:
        connection.execute(jobs.delete().where(jobs.c.id == job))


def clear_leftovers(connection: Connection, job: str) -> None:
    """Record that nothing is left of a cancelled job, and delete it if that was asked for meanwhile."""
    change(connection, job, leftovers=False)
    connection.execute(jobs.delete().where(jobs.c.id == job, jobs.c.owner == NOBODY))


def log(connection: Connection, job: str, text: str) -> None:
    """Add a line to a job's log."""
    connection.execute(insert(lines).values(job=job, at=time.time(), text=text))


def log_lines(connection: Connection, job: str, after: int, limit: int) -> Sequence[Row[Any]]:
    """Up to `limit` lines of a job's log that follow line number `after`, oldest first."""
    query = select(lines).where(lines.c.job == job, lines.c.line > after).order_by(lines.c.line).limit(limit)
    return connection.execute(query).all()
