"""Schedulers and workers in processes of their own."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from services.decoding.process import NAME


def wait(until: Callable[[], object], seconds: float = 120) -> None:
    """Wait for something to become true; how long is no matter, but that it does."""
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.1)


@contextmanager
def started(
    log: Path, *command: str, within: Sequence[str] = (), **environment: str
) -> Iterator[subprocess.Popen[str]]:
    """A command of envmatte that runs, its stderr in a file; it and all that it started are gone in the end.

    ``within`` is put before it, to have it run on another host say.
    """
    with log.open("ab") as stderr:
        process = subprocess.Popen(
            [*within, sys.executable, "-m", "services", *command],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            start_new_session=True,
            env=os.environ | {"TMPDIR": str(log.parent)} | environment,
        )
    assert process.stdout is not None
    try:
        yield process
    finally:
        tree = [*children(process), psutil.Process(process.pid)] if process.poll() is None else []
        for one in tree:
            one.kill()
        process.wait()
        process.stdout.close()


def address(process: subprocess.Popen[str]) -> str:
    """Where a scheduler listens, as soon as it does."""
    assert process.stdout is not None
    line = process.stdout.readline()
    assert " at t" in line, line
    return line.rsplit(" at ", 1)[1].strip()


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """What a process has started, and they in turn."""
    return psutil.Process(process.pid).children(recursive=True)


def workers(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The worker processes of a process: those that its fork server has forked, and that decode nothing for its API."""
    return [one for one, name in _forked(process) if name != NAME]


def decoders(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The processes in which the API of a process has pictures decoded."""
    return [one for one, name in _forked(process) if name == NAME]


def _forked(process: subprocess.Popen[str]) -> list[tuple[psutil.Process, str]]:
    found = []
    for one in children(process):
        with suppress(psutil.NoSuchProcess):  # nor one that has just ended
            if any("forkserver" in argument for argument in psutil.Process(one.ppid()).cmdline()):
                found.append((one, one.name()))
    return found


def running(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Those that have not ended; one that nobody has waited for has."""
    return [one for one in processes if one.is_running() and one.status() != psutil.STATUS_ZOMBIE]


def listening(process: psutil.Process) -> list[tuple[str, int]]:
    """Where a process listens."""
    found = process.net_connections()
    return [(one.laddr.ip, one.laddr.port) for one in found if one.status == psutil.CONN_LISTEN]
