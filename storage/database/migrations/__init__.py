"""The database's schema, revision after revision: how a database of any age becomes what this code works with.

A change of the tables in `storage.database.tables` is a new file in ``versions``; a revision is never edited. None
can be taken back: an upgrade that fails or is interrupted leaves the schema as it was, and one that went well stays.
"""

import logging
from threading import Lock

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection

from storage.errors import Conflict

logger = logging.getLogger(__name__)

_config = Config()
_config.set_main_option("script_location", "storage.database:migrations")
_one_at_a_time = Lock()  # alembic keeps the upgrade that goes on in globals


def revision(connection: Connection) -> str | None:
    """The revision that a database's schema has; None if it has none, or is older than revisions are."""
    return MigrationContext.configure(connection).get_current_revision()


def newest() -> str:
    """The revision that this code works with."""
    head = ScriptDirectory.from_config(_config).get_current_head()
    assert head is not None
    return head


def require_known(revision: str, what: str) -> None:
    """See that a revision is one that this code knows.

    Parameters
    ----------
    what : str
        Has the revision: ``the database`` say.

    Raises
    ------
    Conflict
        If it is newer.
    """
    known = {script.revision for script in ScriptDirectory.from_config(_config).walk_revisions()}
    if revision not in known:
        raise Conflict(
            f"{what} is of a newer envmatte: it has revision {revision}, and this one knows those up to "
            f"{newest()}; install the newer envmatte, or use another {what.split()[-1]}"
        )


def upgrade(connection: Connection, to: str = "head") -> None:
    """Bring a database's schema up to a revision, within the connection's transaction.

    Raises
    ------
    Conflict
        If the schema is newer than this code.
    """
    before = revision(connection)
    if before is not None:
        require_known(before, "the database")
    with _one_at_a_time:
        _config.attributes["connection"] = connection
        try:
            command.upgrade(_config, to)
        finally:
            del _config.attributes["connection"]
    after = revision(connection)
    if after != before:
        logger.info("the database's schema is upgraded from revision %s to %s", before or "none", after)
