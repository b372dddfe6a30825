"""Files from the service: in ranges, or whole."""

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from services.runtime.whole_files import is_standard_output, open_whole

if TYPE_CHECKING:
    from services.client._session import Session

RANGE = 8 << 20
"""Bytes of a request."""


def by_ranges(http: "Session", path: str, target: BinaryIO) -> None:
    """Write a file of the service to an open one, a range at a time, of which each is retried by itself."""
    at, size = 0, 1
    while at < size:
        asked = {"Range": f"bytes={at}-{at + RANGE - 1}"}
        answer = http.send("GET", path, headers=asked, file=True)
        at += target.write(answer.content)
        size = int(answer.headers.get("Content-Range", f"/{at}").rpartition("/")[2])


def whole(http: "Session", path: str, file: Path, progress: Callable[[int, int], None] | None) -> None:
    """Write a file of the service to one that appears once it is complete; to a pipe as it comes.

    Parameters
    ----------
    progress : callable, optional
        Is called with the bytes received, and with all there are.
    """
    with open_whole(file) as out:
        may_restart = stat.S_ISREG(os.fstat(out.fileno()).st_mode) and not is_standard_output(file)

        def get() -> None:
            with http.streamed("GET", path, file=True) as answer:
                size, done = int(http.header(answer, "Content-Length")), 0
                if may_restart:
                    out.seek(0)
                    out.truncate()
                for data in answer.iter_bytes():
                    done += out.write(data)
                    if progress:
                        progress(done, size)

        http.patiently(get, safe=may_restart)
