"""Room that a SQLite database keeps within its own files, so that rows can be changed and deleted on a full disk.

Its log (``-wal``) is as long as one may get between two checkpoints, and the database has free pages for some new
rows. Neither shrinks while the database is open, and no other file can take them. PostgreSQL has no such reserve: its
disk is not one that uploads fill.
"""

import os
from contextlib import suppress
from pathlib import Path

from sqlalchemy import Connection, Engine

from storage.database.engine import reading, writing
from storage.disks import spare_bytes

LOG = 8 << 20
"""Bytes of the log. SQLite writes it from its start again after some 4 MiB, unless a reader holds that up."""
PAGES = 4 << 20
"""Bytes of free pages."""


def file_of(engine: Engine) -> Path | None:
    """The file of a SQLite database; None for PostgreSQL."""
    return Path(str(engine.url.database)) if engine.dialect.name == "sqlite" else None


def keep_reserve(engine: Engine) -> None:
    """Reserve what is missing, unless the disk is already short of room; a repeated call costs two look-ups."""
    file = file_of(engine)
    if file is None or spare_bytes(file.parent) < LOG + PAGES:
        return
    log = file.with_name(f"{file.name}-wal")
    with reading(engine) as c:
        pages = _free_bytes(c)  # by then SQLite has created the log
    if log.is_file() and log.stat().st_size < LOG:
        # Within a transaction, as nobody else appends to the log then. SQLite ignores what follows its last entry. The
        # log alone may be opened besides SQLite: closing the database's file would drop the locks of this process.
        with suppress(OSError), writing(engine), log.open("r+b") as opened:  # not every file system can do it
            os.posix_fallocate(opened.fileno(), 0, LOG)
    if pages < PAGES // 2:
        with writing(engine) as c:
            c.exec_driver_sql("CREATE TABLE IF NOT EXISTS reserve (bytes BLOB)")
            c.exec_driver_sql("INSERT INTO reserve VALUES (zeroblob(?))", (PAGES,))
        with writing(engine) as c:
            c.exec_driver_sql("DROP TABLE IF EXISTS reserve")  # another process may do the same


def _free_bytes(connection: Connection) -> int:
    pages, size = (
        connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in ("freelist_count", "page_size")
    )
    return int(pages) * int(size)
