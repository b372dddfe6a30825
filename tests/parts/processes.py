"""Commands that run beside a test, and processes that are still there."""

import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import psutil


@contextmanager
def running(command: Sequence[str], **options: Any) -> Iterator["subprocess.Popen[str]"]:
    """Run a command beside the test, its output in pipes; whatever is left of it at the end is killed.

    Without the kill a test that fails would leave a process behind, and the warning about it would fail another test.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes | options) as process:
        try:
            yield process
        finally:
            process.kill()


def alive(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Those that have not ended; zombies have."""
    return [one for one in processes if _is_alive(one)]


def _is_alive(one: psutil.Process) -> bool:
    try:
        return one.is_running() and one.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:  # it has ended between the two
        return False


def interrupt(process: "subprocess.Popen[str]") -> tuple[int, str]:
    """Interrupt a command as Ctrl-C does; returns its exit code and the rest of its stderr."""
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=120)
    return process.returncode, stderr
