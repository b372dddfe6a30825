"""The lock of a data folder."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage.errors import Conflict


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
