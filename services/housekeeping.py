"""What the coordinator removes from the store because nothing refers to it."""

import logging

from sqlalchemy import Engine, select

from services.kinds import may_be_retried
from storage import database, jobs, uploads
from storage.database import reading
from storage.objects import Objects

logger = logging.getLogger(__name__)

KEPT = 3600.0
"""Seconds for which what nothing refers to is left alone: someone may be about to write down that it is there."""


def sweep(engine: Engine, objects: Objects, seconds: float = KEPT) -> None:
    """Remove what has no row in the database: what killed processes left.

    Parameters
    ----------
    seconds : float
        For how long it must not have been written to. 0 is for whoever knows that nobody writes.
    """
    with reading(engine) as c:
        rows = c.execute(select(database.captures)).all()
        kept = [row for row in rows if row.state != "failed" or may_be_retried(row.problem)]
        under_way = {id: uploads.parts_of(c, id) for id in c.scalars(select(database.uploads.c.id))}
        known = {
            "captures": {row.id for row in kept},
            "uploads": {row.id for row in kept if row.state != "ready"} | under_way.keys(),
            "mattes": set(c.scalars(select(database.mattes.c.id))),
            "composites": {
                row.id
                for row in jobs.composites(c)
                if row.state != "cancelled" and (row.problem is None or may_be_retried(row.problem))
            },
        }
    for folder, names in known.items():
        for name in objects.stale(folder, seconds, but={*names, "zarr.json"}):
            logger.info("removing %s/%s, which nothing refers to", folder, name)
            objects.delete(f"{folder}/{name}")
    if not seconds:
        objects.sweep("uploads")
        objects.sweep("composites")
        for upload, parts in under_way.items():
            uploads.sweep(objects, upload, parts)
