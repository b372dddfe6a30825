"""The process that workers are forked from, where it can't start."""

import subprocess
import sys
from pathlib import Path

import pytest

UNWRITABLE = 'mount -t tmpfs -o ro none /dev/shm && exec "$@"'


def test_machine_without_shared_memory_is_named(tmp_path: Path) -> None:
    alone = ["unshare", "--map-root-user", "--mount", "sh", "-c", UNWRITABLE, "sh"]
    tried = subprocess.run([*alone, "true"], capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(f"no file system can be mounted for a process here: {tried.stderr.strip()}")
    serve = [sys.executable, "-m", "services", "serve", "--data", str(tmp_path / "data"), "--port", "0"]
    served = subprocess.run([*alone, *serve], capture_output=True, text=True, timeout=120)
    assert served.returncode == 1
    assert served.stderr.splitlines()[-1] == (
        "Error: processes can't share locks here: Read-only file system. Mount a tmpfs that this user may write to on "
        "/dev/shm"
    )
    assert "Traceback" not in served.stderr
