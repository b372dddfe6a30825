"""Files that are written whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def open_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears only once all of it is written.

    What exists and is no regular file, such as a pipe or a device, is written to directly. It can't be sought in.
    """
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
