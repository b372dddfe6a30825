"""Files that are written whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

STANDARD_OUTPUT = 1
"""Its file descriptor."""


@contextmanager
def open_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears only once all of it is written.

    Standard output, and what exists and is no regular file, such as a pipe or a device, are written to directly.
    """
    if is_standard_output(path):
        with os.fdopen(os.dup(STANDARD_OUTPUT), "wb") as file:
            yield file
        return
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    # What a link leads to is written, as by all else that writes files.
    target = Path(os.path.realpath(path))
    with tempfile.TemporaryDirectory(prefix=".envmatte-", dir=target.parent) as beside:
        part = Path(beside, "part")
        with part.open("wb") as file:
            yield file
        os.replace(part, target)


def is_standard_output(path: Path) -> bool:
    """Whether a file is what standard output goes to, as ``/dev/stdout`` always is."""
    try:
        return os.path.samestat(path.stat(), os.fstat(STANDARD_OUTPUT))
    except OSError:  # there is no such file, or standard output is closed
        return False
