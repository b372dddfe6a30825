"""Schema migrations: they bring a database of any age to the tables that this code works with.

A change of `storage.database.tables` needs a new file in ``versions`` and its number in `storage.database.revision`;
a released revision is never edited. There are no downgrades. An upgrade is one transaction: if it fails or is
interrupted, the schema stays as it was.
"""

import logging
from threading import Lock

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

from storage.database.revision import NEWEST, revision
from storage.errors import Conflict

logger = logging.getLogger(__name__)

_config = Config()
_config.set_main_option("script_location", "storage.database:migrations")
_lock = Lock()  # alembic keeps the running upgrade in globals


def known() -> set[str]:
    """All revisions that this code can upgrade."""
    return {script.revision for script in ScriptDirectory.from_config(_config).walk_revisions()}


def require_known(found: str, what: str) -> None:
    """Refuse a revision that this code does not know.

    Parameters
    ----------
    found : str
        The revision.
    what : str
        What has this revision, for the message: ``the database`` or ``the backup``.

    Raises
    ------
    Conflict
        If the revision is of a newer envmatte.
    """
    if found not in known():
        raise Conflict(
            f"{what} was written by a newer envmatte: it has revision {found}, and this envmatte knows revisions up "
            f"to {NEWEST}; install the newer envmatte, or use another {what.split()[-1]}"
        )


def upgrade(connection: Connection, to: str = NEWEST) -> None:
    """Upgrade a database's schema to a revision, within the connection's transaction.

    Raises
    ------
    Conflict
        If the schema is newer than this code.
    """
    before = revision(connection)
    if before is not None:
        require_known(before, "the database")
    if connection.dialect.name == "postgresql":  # it may take minutes, and would be cancelled at every start
        connection.exec_driver_sql("SET LOCAL statement_timeout = 0")
    with _lock:
        _config.attributes["connection"] = connection
        try:
            command.upgrade(_config, to)
        finally:
            del _config.attributes["connection"]
    after = revision(connection)
    if after != before:
        logger.info("upgraded the database schema from revision %s to %s", before or "none", after)
