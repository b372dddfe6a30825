"""The data folder: made for its owner alone, and locked while it is served."""

import fcntl
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage.errors import Conflict

logger = logging.getLogger(__name__)


def make_data(data: Path) -> None:
    """Make a data folder that no other user of the machine can enter.

    The rights to one that exists are left alone, because somebody may have given them on purpose; a warning says so.

    Raises
    ------
    Conflict
        If it is a file.
    """
    if data.is_file():
        raise Conflict(f"{data} is a file: name a folder with --data")
    if not data.exists():
        data.mkdir(mode=0o700, parents=True, exist_ok=True)
    elif data.stat().st_mode & 0o077:
        logger.warning("other users of this machine can enter %s; `chmod 700 %s` keeps them out", data, data)


@contextmanager
def lock_data(data: Path) -> Iterator[None]:
    """Hold the lock of a data folder: two services on one folder would run the same jobs.

    Raises
    ------
    Conflict
        If another process holds it.
    """
    with (data / "lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Conflict(
                f"another envmatte serves {data} already; use it, stop it, or name another folder with --data"
            ) from error
        yield
