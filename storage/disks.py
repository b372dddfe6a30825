"""How full a disk may be: uploads leave a reserve to the database and to the jobs that are under way."""

import os
import shutil
from pathlib import Path

from storage.errors import FEW_FILES, NEARLY_FULL, NoRoom

RESERVE = 1 << 30
"""Most bytes that are kept in reserve on a disk."""
FILES = 10_000
"""Most files that are kept in reserve: a matte of some megapixels is a thousand."""
SHARE = 20
"""On a small disk the reserve is what it holds divided by this."""


def spare_bytes(folder: Path) -> int:
    """Bytes that uploads may still take of a folder's disk; negative while its reserve is in use."""
    disk = shutil.disk_usage(folder)
    return disk.free - _reserve(disk.total)


def require_reserve(folder: Path) -> None:
    """Check that a folder's disk has half of its reserve left: jobs and rows may use the other half.

    Raises
    ------
    NoRoom
    """
    disk = shutil.disk_usage(folder)
    if disk.free < _reserve(disk.total) // 2:
        raise NoRoom(NEARLY_FULL)
    files = os.statvfs(folder)
    if files.f_favail < min(files.f_files // SHARE, FILES) // 2:  # f_files is 0 where there is no limit
        raise NoRoom(FEW_FILES)


def _reserve(total: int) -> int:
    return min(total // SHARE, RESERVE)
