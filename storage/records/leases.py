"""The lease of the coordinator: of all that run, the one that holds it drives the jobs.

It is a row of the database with a token that grows by one whenever the lease changes hands. A coordinator extends it by
its heartbeat, and checks the token first in every transaction by which it writes: one that was frozen or cut off while
another took over finds another token, and nothing of what it wanted to write is committed. Times are the database's,
so that clocks of hosts that differ change nothing.
"""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, insert, select, update

from storage.database.dialects import clock
from storage.database.tables import coordinator

SECONDS = 10.0
"""How long a lease holds without a heartbeat."""


class Superseded(Exception):
    """Another coordinator has taken over."""


@dataclass(frozen=True)
class Heartbeat:
    """The last sign of life of a coordinator.

    Attributes
    ----------
    holder : str or None
        Whose it was; None if it has given the lease back.
    seconds : float
        How long ago that was.
    cluster : dict
        The cluster as it saw it: ``workers``, and ``problem``, what is wrong in words or None.
    """

    holder: str | None
    seconds: float
    cluster: dict[str, Any]


EMPTY_CLUSTER: dict[str, Any] = {"workers": [], "problem": None}


def acquire(connection: Connection, holder: str, *, seize: bool = False) -> int | None:
    """Take the lease if it is free or has run out; returns the token, or None while another holds it.

    Parameters
    ----------
    holder : str
        Names the process to people.
    seize : bool
        Take it from whoever holds it: the caller knows that there is nobody else.
    """
    row = connection.execute(select(coordinator, clock().label("now"))).one_or_none()
    if row is None:
        now = connection.execute(select(clock())).scalar_one()
        values = {"id": 1, "token": 1, "holder": holder, "cluster": EMPTY_CLUSTER}
        connection.execute(insert(coordinator).values(beat_at=now, expires_at=now + SECONDS, **values))
        return 1
    if row.holder is not None and row.expires_at > row.now and not seize:
        return None
    values = {"token": row.token + 1, "holder": holder, "cluster": EMPTY_CLUSTER}
    connection.execute(update(coordinator).values(beat_at=row.now, expires_at=row.now + SECONDS, **values))
    return int(row.token) + 1


def require_held(connection: Connection, token: int) -> None:
    """See that the lease is still held by a token.

    Raises
    ------
    Superseded
        If it is not: the transaction must not be committed.
    """
    held = coordinator.c.holder.is_not(None)
    if connection.scalar(select(coordinator.c.token).where(held)) != token:
        raise Superseded("another coordinator drives the jobs now")


def renew(connection: Connection, token: int, cluster: dict[str, Any]) -> None:
    """Extend the lease, and write down the cluster.

    Raises
    ------
    Superseded
    """
    require_held(connection, token)
    now = clock()
    connection.execute(update(coordinator).values(beat_at=now, expires_at=now + SECONDS, cluster=cluster))


def release(connection: Connection, token: int) -> None:
    """Free the lease for the next, if it is still held."""
    connection.execute(update(coordinator).where(coordinator.c.token == token).values(holder=None))


def check_writable(connection: Connection) -> None:
    """Write what is there already, to see that the database can be written to."""
    connection.execute(update(coordinator).values(token=coordinator.c.token))


def last_heartbeat(connection: Connection) -> Heartbeat | None:
    """The last sign of life of a coordinator, if there ever was one."""
    row = connection.execute(select(coordinator, clock().label("now"))).one_or_none()
    return None if row is None else Heartbeat(row.holder, row.now - row.beat_at, row.cluster)
