"""Webhook deliveries: a row for each job that has ended and has a webhook, until it is delivered or given up.

The row is added in the transaction that ends the job and holds the whole body, so neither a restart nor the deletion of
the job loses it. A receiver that responds late may get the same delivery twice; its id tells.
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
"""Seconds between a failed attempt and the next: nine attempts within a day."""
ATTEMPT_SECONDS = 60.0
"""Seconds after which an attempt without a recorded result is repeated: its process has died."""


def add(connection: Connection, job: Row[Any]) -> None:
    """Queue the delivery for a job that has just ended."""
    delivery = new_id()
    ended = {
        name: getattr(job, name) or None for name in ("id", "kind", "state", "capture", "matte", "problem")
    }
    ended |= {name: _time(getattr(job, name)) for name in ("created_at", "finished_at")}
    now = time.time()
    body = json.dumps(
        {"id": delivery, "event": f"job.{job.state}", "created_at": _time(now), "job": ended},
        separators=(",", ":"),
    )
    row = {"id": delivery, "job": job.id, "url": job.webhook, "body": body, "attempts": 0}
    connection.execute(insert(deliveries).values(**row, due_at=now, created_at=now))


def any_due(connection: Connection) -> bool:
    """Whether a delivery is due."""
    return connection.scalar(select(deliveries.c.id).where(_is_due()).limit(1)) is not None


def claim(connection: Connection, most: int) -> Sequence[Row[Any]]:
    """Count an attempt at up to `most` due deliveries and return them, those with the fewest attempts first."""
    query = select(deliveries.c.id).where(_is_due())
    query = query.order_by(deliveries.c.attempts, deliveries.c.due_at).limit(most)
    claimed = deliveries.c.id.in_(connection.scalars(query).all())
    values = {"attempts": deliveries.c.attempts + 1, "due_at": time.time() + ATTEMPT_SECONDS}
    connection.execute(update(deliveries).where(claimed).values(values))
    return connection.execute(select(deliveries).where(claimed)).all()


def delete(connection: Connection, delivery: str) -> None:
    """Delete a delivery that the receiver has accepted."""
    connection.execute(deliveries.delete().where(deliveries.c.id == delivery))


def schedule_retry(connection: Connection, delivery: str, attempts: int) -> float | None:
    """Schedule the next attempt; returns the seconds until then, or None if the delivery was given up."""
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
