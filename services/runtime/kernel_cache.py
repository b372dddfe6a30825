"""Where numba keeps the kernels that it has compiled."""

import os
from pathlib import Path

import workflows
from storage.errors import Unavailable


def require_kernel_cache() -> None:
    """Check that numba finds a folder for kernels, before one is imported: it ends with a traceback otherwise.

    Raises
    ------
    Unavailable
        If this user can write to none of those where it looks.
    """
    named = os.environ.get("NUMBA_CACHE_DIR")
    beside = Path(workflows.__path__[0], "recovery", "__pycache__")
    users = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "numba")
    if not any(map(_can_be_written, [*([Path(named)] if named else []), beside, users])):
        raise Unavailable(
            "no folder for compiled kernels: set NUMBA_CACHE_DIR to one that this user can write to"
        )


def _can_be_written(folder: Path) -> bool:
    while not os.path.exists(folder):  # it is made
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)
