"""What is said about a job besides its row: the coordinator, the jobs beside it, and earlier ingests."""

from functools import cached_property
from typing import Any

from sqlalchemy import Connection, func, select

from storage import statistics
from storage.database.owners import across_owners
from storage.database.tables import captures, jobs
from storage.records import leases
from storage.records.leases import Heartbeat


class Situation:
    """The situation that jobs are in; each part is read when it is first needed, once for a whole page of jobs.

    Parameters
    ----------
    connection : sqlalchemy.Connection
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    @cached_property
    def heartbeat(self) -> Heartbeat | None:
        """The coordinator's last heartbeat."""
        return leases.last_heartbeat(self._connection)

    @property
    def workers(self) -> int:
        """The number of workers, as the coordinator last saw it; 0 if there has been none."""
        return len(self.heartbeat.cluster["workers"]) if self.heartbeat else 0

    @cached_property
    def running(self) -> int:
        """The number of running jobs of all owners."""
        query = select(func.count()).where(jobs.c.state == "running")
        return self._connection.scalar(across_owners(query)) or 0

    @cached_property
    def ingesting(self) -> set[str]:
        """The captures that are being ingested."""
        return set(self._connection.scalars(select(captures.c.id).where(captures.c.state == "ingesting")))

    @cached_property
    def recent_ingests(self) -> list[tuple[dict[str, Any], float]]:
        """See `storage.statistics.recent_ingests`."""
        return statistics.recent_ingests(self._connection, limit=16)
