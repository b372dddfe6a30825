"""The coordinator's lease: of several running coordinators, the one that holds it runs the jobs.

The lease is a row of the database with a token that grows by one whenever it changes hands. A coordinator renews the
lease with each heartbeat and checks the token first in every transaction that writes. A coordinator that was frozen or
cut off while another took over finds a different token, and nothing that it writes is committed. Times are by the
database's clock, so the clocks of hosts may differ. If that clock jumps, another coordinator may take over early, but
never late: a lease that ends in more than `SECONDS` was written before the clock went back.
"""

from dataclasses import dataclass

from sqlalchemy import Connection, insert, select, update

from storage.cluster_state import EMPTY_CLUSTER, ClusterState
from storage.database.dialects import clock
from storage.database.tables import coordinator

SECONDS = 10.0
"""How long a lease lasts without a heartbeat."""


class Superseded(Exception):
    """Another coordinator has taken over."""


@dataclass(frozen=True)
class Heartbeat:
    """The last heartbeat of a coordinator.

    Attributes
    ----------
    holder : str or None
        The process that sent it; None if it has released the lease.
    seconds : float
        Its age; for a moment more if the clock has jumped.
    cluster : ClusterState
        The cluster as the coordinator saw it.
    """

    holder: str | None
    seconds: float
    cluster: ClusterState


def acquire(connection: Connection, holder: str, *, seize: bool = False) -> int | None:
    """Acquire the lease if it is free or has expired; returns its token, or None while another process holds it.

    Parameters
    ----------
    holder : str
        Name of the process, for people.
    seize : bool
        Acquire it even if another process holds it; the caller knows that none is running.
    """
    row = connection.execute(select(coordinator, clock().label("now"))).one_or_none()
    if row is None:
        now = connection.execute(select(clock())).scalar_one()
        values = {"id": 1, "token": 1, "holder": holder, "cluster": EMPTY_CLUSTER}
        connection.execute(insert(coordinator).values(beat_at=now, expires_at=now + SECONDS, **values))
        return 1
    if row.holder is not None and 0 < row.expires_at - row.now < 2 * SECONDS and not seize:
        return None
    values = {"token": row.token + 1, "holder": holder, "cluster": EMPTY_CLUSTER}
    connection.execute(update(coordinator).values(beat_at=row.now, expires_at=row.now + SECONDS, **values))
    return int(row.token) + 1


def require_held(connection: Connection, token: int) -> None:
    """Check that a token still holds the lease.

    Raises
    ------
    Superseded
        If it does not; the transaction must not be committed.
    """
    held = coordinator.c.holder.is_not(None)
    if connection.scalar(select(coordinator.c.token).where(held)) != token:
        raise Superseded("another coordinator runs the jobs now")


def renew(connection: Connection, token: int, cluster: ClusterState) -> None:
    """Renew the lease and store the state of the cluster.

    Raises
    ------
    Superseded
    """
    require_held(connection, token)
    now = clock()
    connection.execute(update(coordinator).values(beat_at=now, expires_at=now + SECONDS, cluster=cluster))


def release(connection: Connection, token: int) -> None:
    """Release the lease if the token still holds it."""
    connection.execute(update(coordinator).where(coordinator.c.token == token).values(holder=None))


def last_heartbeat(connection: Connection) -> Heartbeat | None:
    """The last heartbeat of a coordinator; None if there never was one."""
    row = connection.execute(select(coordinator, clock().label("now"))).one_or_none()
    return None if row is None else Heartbeat(row.holder, abs(row.now - row.beat_at), row.cluster)
