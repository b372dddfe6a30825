"""Ids and paths of records, and files that are sent."""

import os
import stat
from pathlib import Path
from urllib.parse import quote

from services.client._errors import NotFound
from services.client._records import Record


def id_of(record: Record | str) -> str:
    """The id of a record, or the id itself; one that would be another path is that of none."""
    id = record if isinstance(record, str) else record.id
    if id in ("", ".", ".."):
        raise NotFound(
            {"title": "Not found", "status": 404, "detail": f"{id!r} is not an id: give one of those listed"}
        )
    return id


def path_of(kind: type[Record], record: Record | str) -> str:
    """The path of a record."""
    return f"{kind.path}/{quote(id_of(record), safe='')}"


def state_of(file: Path) -> os.stat_result:
    """The state of a file that is sent: its size is announced, so a pipe is no file.

    Raises
    ------
    ValueError
        If it is not a file.
    """
    state = file.stat()
    if not stat.S_ISREG(state.st_mode):
        raise ValueError(f"{file} is not a file: write what it holds into one and give that")
    return state
