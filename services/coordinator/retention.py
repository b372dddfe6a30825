"""Housekeeping: removes what has expired and what nothing refers to, and counts the bytes of what is stored."""

import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice

from sqlalchemy import Connection, Engine, delete, exists, select, update

from storage.database import tables
from storage.database.dialects import clock
from storage.database.engine import reading, writing
from storage.layout import captures, composites, mattes
from storage.layout import uploads as stored_uploads
from storage.maintenance import inventory
from storage.objects import marker
from storage.objects.store import Objects
from storage.records import bodies, jobs, links, uploads

logger = logging.getLogger(__name__)

MOST = 1000
"""Rows that are deleted in one transaction, while other writers wait, or looked up by one query."""


def delete_expired(connection: Connection) -> list[str]:
    """Delete the rows of some expired uploads, captures and mattes; returns their folders in the store.

    Of a large backlog the next call deletes more. What an active job works on is kept until the job has ended. Rows of
    dead processes' requests, and links that have expired, are deleted too.
    """
    bodies.delete_lapsed(connection)
    links.delete_expired(connection)
    gone = [stored_uploads.path(upload) for upload in uploads.delete_expired(connection)]
    for table, making, where in (
        (tables.captures, "ingesting", (captures.path, stored_uploads.path)),
        (tables.mattes, "recovering", (mattes.path,)),
    ):
        what = "capture" if table is tables.captures else "matte"
        used = tables.jobs.c[what]
        busy = select(used).where(jobs.is_in_use(what), used.is_not(None))
        over = (table.c.expires_at <= clock(), table.c.state != making, table.c.id.not_in(busy))
        some = select(table.c.id).where(*over).limit(MOST)
        found = connection.scalars(delete(table).where(table.c.id.in_(some)).returning(table.c.id))
        gone += [path(one) for one in sorted(found) for path in where]
    return gone


def delete_old_jobs(engine: Engine, objects: Objects, seconds: float | None) -> None:
    """Delete some of the jobs that ended long ago, and Idempotency-Keys of what no longer exists.

    A job is deleted with its tiles, its log and the video of a composite, of which it is the only record. An ingest is
    kept as long as its capture, a recovery as long as its matte.

    Parameters
    ----------
    seconds : float, optional
        How long jobs are kept after they have ended; None keeps them for ever.
    """
    job, key = tables.jobs, tables.made
    of_capture = exists().where(tables.captures.c.id == job.c.capture)
    of_matte = exists().where(tables.mattes.c.id == job.c.matte)
    in_use = ((job.c.kind == "ingest") & of_capture) | ((job.c.kind == "recover") & of_matte)
    made = [exists().where(table.c.id == key.c.id) for table in (tables.captures, tables.mattes, job)]
    gone = select(key.c.id).where(*(~one for one in made)).limit(MOST)
    with reading(engine) as c:  # other writers need not wait while this scans all rows
        keys = c.scalars(gone).all()
        jobs_over: Sequence[str] = ()
        over = (job.c.finished_at <= time.time() - (seconds or 0)) & ~job.c.leftovers
        if seconds is not None:
            jobs_over = c.scalars(select(job.c.id).where(over, ~in_use).limit(MOST)).all()
    if not (keys or jobs_over):
        return
    with writing(engine) as c:
        c.execute(delete(key).where(key.c.id.in_(keys)))
        # A job that was retried meanwhile has not ended.
        deleted = delete(job).where(job.c.id.in_(jobs_over), over).returning(job.c.id, job.c.kind)
        composed = [row.id for row in c.execute(deleted) if row.kind == "composite"]
    for one in composed:
        remove(objects, composites.path(one))


def remove(objects: Objects, path: str) -> None:
    """Remove the files of a deleted row."""
    with suppress(OSError):  # something is still written there: its writer removes it, or a sweep does
        objects.delete(path)


def count_bytes(engine: Engine, objects: Objects) -> None:
    """Record how many bytes new captures, mattes and videos have in the store; quotas use these numbers."""
    marker.require_mounted(objects)
    for table, is_complete, folders in (
        (tables.captures, tables.captures.c.state != "ingesting", (captures.path, stored_uploads.path)),
        (tables.mattes, tables.mattes.c.state != "recovering", (mattes.path,)),
        (
            tables.jobs,
            (tables.jobs.c.kind == "composite") & (tables.jobs.c.state == "succeeded"),
            (composites.path,),
        ),
    ):
        with reading(engine) as c:
            new = c.scalars(select(table.c.id).where(is_complete, table.c.stored.is_(None))).all()
        for one in new:
            stored = sum(sum(objects.sizes(path(one)).values()) for path in folders)
            with writing(engine) as c:
                uncounted = (table.c.id == one, is_complete, table.c.stored.is_(None))
                c.execute(update(table).where(*uncounted).values(stored=stored))


def sweep_uploads(engine: Engine, objects: Objects) -> None:
    """Remove what killed requests have left of uploads; only while no request is under way."""
    with writing(engine) as c:
        bodies.delete_lapsed(c, 0)
    objects.sweep("uploads")
    with reading(engine) as c:
        known = list(inventory.items(c, only="uploads"))
    for item in known:
        stored_uploads.sweep(objects, item.id, item.parts)


def sweep(engine: Engine, objects: Objects, before: float) -> None:
    """Remove what has no row in the database and was written before a time: killed processes have left it.

    Parameters
    ----------
    before : float
        By the store's clock, see `Objects.clock`. What was written later may be about to get a row.
    """
    marker.require_mounted(objects)  # in place of its folder, that of another installation may be mounted
    for folder in inventory.FOLDERS:
        names = iter(objects.names(folder))
        while some := list(islice(names, MOST)):
            with reading(engine) as c:
                strangers = set(some) - inventory.known_names(c, folder, some) - {"zarr.json"}
            for path in (f"{folder}/{name}" for name in sorted(strangers)):
                if objects.written_at(path) < before:
                    logger.info("removing %s, which nothing refers to", path)
                    objects.delete(path)
    objects.sweep("composites", before)
