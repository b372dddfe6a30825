"""What is to be told to webhooks: a row for each ending of a job that has one, until it is delivered or given up.

A row is made in the transaction that ends its job, and holds all that is sent, so that neither a restart nor the job's
deletion loses it. What is sent to one that answers late may be sent again: receivers tell by the id.
"""

import json
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from storage.database.rows import new_id
from storage.database.tables import deliveries

DELAYS = (5.0, 30.0, 120.0, 600.0, 3600.0, 3 * 3600.0, 6 * 3600.0, 12 * 3600.0)
"""Seconds from each failed attempt to the next: nine attempts within a day."""
ATTEMPT_SECONDS = 60.0
"""Seconds after which an attempt of which nothing was written down counts as lost with its process."""


def add(connection: Connection, job: Row[Any]) -> None:
    """Queue what is told about a job that has just ended."""
    delivery = new_id()
    told = {
        name: getattr(job, name) or None for name in ("id", "kind", "state", "capture", "matte", "problem")
    }
    told |= {name: _time(getattr(job, name)) for name in ("created_at", "finished_at")}
    now = time.time()
    body = json.dumps(
        {"id": delivery, "event": f"job.{job.state}", "created_at": _time(now), "job": told},
        separators=(",", ":"),
    )
    row = {"id": delivery, "job": job.id, "url": job.webhook, "body": body, "attempts": 0}
    connection.execute(insert(deliveries).values(**row, due_at=now, created_at=now))


def any_due(connection: Connection) -> bool:
    """Whether something is to be sent now."""
    return connection.scalar(select(deliveries.c.id).where(_is_due()).limit(1)) is not None


def claim(connection: Connection, most: int) -> Sequence[Row[Any]]:
    """Count an attempt at what is to be sent now; what was tried least comes first."""
    query = select(deliveries.c.id).where(_is_due())
    query = query.order_by(deliveries.c.attempts, deliveries.c.due_at).limit(most)
    claimed = deliveries.c.id.in_(connection.scalars(query).all())
    values = {"attempts": deliveries.c.attempts + 1, "due_at": time.time() + ATTEMPT_SECONDS}
    connection.execute(update(deliveries).where(claimed).values(values))
    return connection.execute(select(deliveries).where(claimed)).all()


def delete(connection: Connection, delivery: str) -> None:
    """Forget what was taken."""
    connection.execute(deliveries.delete().where(deliveries.c.id == delivery))


def schedule_retry(connection: Connection, delivery: str, attempts: int) -> float | None:
    """Have it tried again; returns the seconds until then, or None if it was given up."""
    if attempts > len(DELAYS):
        delete(connection, delivery)
        return None
    delay = DELAYS[attempts - 1]
    due = update(deliveries).where(deliveries.c.id == delivery).values(due_at=time.time() + delay)
    connection.execute(due)
    return delay


def _is_due() -> Any:
    return deliveries.c.due_at <= time.time()


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat().replace("+00:00", "Z")
