"""The command line in tests: its commands, and how they are run."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import click

from services.cli.main import main
from tests.parts.processes import interrupt, running

ROOT = Path(__file__).parents[3]
COMMAND = [sys.executable, "-m", "services"]
UNREACHABLE = ["--url", "http://127.0.0.1:9"]


def envmatte(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [*COMMAND, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=os.environ | environment)


def interrupted(command: list[str], arrived: threading.Event) -> tuple[int, str]:
    """Run a command and interrupt it once a request has arrived; returns its exit code and the end of its stderr."""
    with running(command) as process:
        assert arrived.wait(120)
        return interrupt(process)


def commands(group: click.Group = main, *above: str) -> Iterator[tuple[str, click.Command]]:
    """Every command and group by its whole name, as `keys make`."""
    for name, command in group.commands.items():
        yield " ".join([*above, name]), command
        if isinstance(command, click.Group):
            yield from commands(command, *above, name)


ALL = dict(commands())
