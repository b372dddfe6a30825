"""Which revision the schema of a database has, and which one this code works with.

Both are answered without alembic, so that a process that opens an up-to-date database does not import it.
"""

from sqlalchemy import Connection, inspect, text

NEWEST = "0015"
"""The newest file in `storage.database.migrations.versions`: the revision of `storage.database.tables`."""


def revision(connection: Connection) -> str | None:
    """The revision of a database's schema; None for an empty database, or one from before there were revisions."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    found: str | None = connection.scalar(text("SELECT version_num FROM alembic_version"))
    return found
