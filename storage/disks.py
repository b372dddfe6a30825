"""How full a disk may be: uploads leave a reserve to the database and to the jobs that are under way."""

import shutil
from pathlib import Path

from storage.errors import NEARLY_FULL, NoRoom

RESERVE = 1 << 30
"""Most bytes that are kept in reserve on a disk."""
SHARE = 20
"""On a small disk the reserve is its size divided by this."""


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


def _reserve(total: int) -> int:
    return min(total // SHARE, RESERVE)
