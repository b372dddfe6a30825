"""The data folder: made for its owner alone, and locked while it is served."""

import fcntl
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage.errors import Conflict, Unavailable

logger = logging.getLogger(__name__)


def make_data(data: Path) -> None:
    """Make a data folder that no other user of the machine can enter.

    The rights to one that exists are left alone, because somebody may have given them on purpose; a warning says so.

    Raises
    ------
    Conflict
        If it is a file.
    Unavailable
        If it can't be made.
    """
    if data.is_file():
        raise Conflict(f"{data} is a file: name a folder with --data")
    if not data.exists():
        try:
            data.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise _unwritable(data, error) from error
    elif data.stat().st_mode & 0o077:
        logger.warning("other users of this machine can enter %s; `chmod 700 %s` keeps them out", data, data)


@contextmanager
def lock_data(data: Path) -> Iterator[None]:
    """Hold the lock of a data folder: two services on one folder would run the same jobs.

    Raises
    ------
    Conflict
        If another process holds it.
    Unavailable
        If the folder can't be written to.
    """
    try:
        lock = (data / "lock").open("a")
    except OSError as error:
        raise _unwritable(data, error) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Conflict(
                f"another envmatte serves {data} already; use it, stop it, or name another folder with --data"
            ) from error
        yield


def _unwritable(data: Path, error: OSError) -> Unavailable:
    reason = (error.strerror or str(error)).lower()
    return Unavailable(f"can't write to {data} ({reason}): name another folder with --data")
