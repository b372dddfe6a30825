"""What a POST with an Idempotency-Key created."""

from sqlalchemy import Connection, insert, select

from storage.database.tables import made


def find(connection: Connection, key: str, call: str) -> str | None:
    """The id of what a call with this Idempotency-Key made, if it made something."""
    return connection.scalar(select(made.c.id).where(made.c.key == key, made.c.call == call))


def add(connection: Connection, key: str, call: str, made_id: str) -> None:
    """Write down what a call with an Idempotency-Key made."""
    connection.execute(insert(made).values(key=key, call=call, id=made_id))
