"""Schedulers and workers in their own processes."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil


@contextmanager
def started(
    log: Path, *command: str, within: Sequence[str] = (), **environment: str
) -> Iterator[subprocess.Popen[str]]:
    """A running command of envmatte, with its stderr in a file; on exit it and its children are killed.

    ``within`` is put before the command, for example to run it on another host.
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
    """The address of a scheduler, as soon as it listens."""
    assert process.stdout is not None
    line = process.stdout.readline()
    assert " at t" in line, line
    return line.rsplit(" at ", 1)[1].strip()


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """All descendants of a process, which must not have ended."""
    assert process.poll() is None, f"{process.args} ended with {process.returncode}"
    return psutil.Process(process.pid).children(recursive=True)


def workers(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The worker processes of a process: those forked by its fork server."""
    return _forked(process, "forkserver")


def decoders(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The decoders of a process and of its workers."""
    return _forked(process, "decoder_server")


def _forked(process: subprocess.Popen[str], server: str) -> list[psutil.Process]:
    found = []
    for one in children(process):
        with suppress(psutil.NoSuchProcess):  # it has just ended
            commands = one.cmdline(), psutil.Process(one.ppid()).cmdline()  # the same, if it was forked
            if all(any(server in argument for argument in command) for command in commands):
                found.append(one)
    return found


def listening(process: psutil.Process) -> list[tuple[str, int]]:
    """Addresses and ports on which a process listens."""
    found = process.net_connections()
    return [(one.laddr.ip, one.laddr.port) for one in found if one.status == psutil.CONN_LISTEN]
