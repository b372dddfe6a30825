"""The log of a job."""

import time
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, insert, select

from storage.database.tables import log


def add(connection: Connection, job: str, text: str) -> None:
    """Add a line to a job's log."""
    connection.execute(insert(log).values(job=job, at=time.time(), text=text))


def lines(connection: Connection, job: str, after: int, limit: int) -> Sequence[Row[Any]]:
    """Up to `limit` lines of a job's log that follow line number `after`, oldest first."""
    query = select(log).where(log.c.job == job, log.c.line > after).order_by(log.c.line).limit(limit)
    return connection.execute(query).all()
