"""What each Idempotency-Key has created, so that a repeated request gets the same response."""

from sqlalchemy import Connection, insert, select

from storage.database.tables import made


def find(connection: Connection, key: str, call: str) -> str | None:
    """The id of what a call with this Idempotency-Key created, if it has created something."""
    return connection.scalar(select(made.c.id).where(made.c.key == key, made.c.call == call))


def add(connection: Connection, key: str, call: str, created: str) -> None:
    """Record what a call with an Idempotency-Key created."""
    connection.execute(insert(made).values(key=key, call=call, id=created))
