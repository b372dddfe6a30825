"""Waiting for what a test has set going elsewhere."""

import subprocess
import time
from collections.abc import Callable


def until(
    condition: Callable[[], object], seconds: float = 120, by: "subprocess.Popen[str] | None" = None
) -> None:
    """Wait until a condition is true; fail after a while, or once the process that makes it true has ended."""
    deadline = time.monotonic() + seconds
    while True:
        # Before the condition, which may be its last act.
        has_ended = by is not None and by.poll() is not None
        if condition():
            return
        assert not has_ended, f"not true when the process ended with {by and by.returncode}"
        assert time.monotonic() < deadline, f"not true after {seconds} seconds"
        time.sleep(0.05)
