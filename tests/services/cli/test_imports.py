"""What commands import: libraries that take long only where they are needed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.api.mattes import layers
from services.cli import keys
from services.cli.remote import jobs, mattes
from storage.database import owners
from storage.records import api_keys
from tests.services.cli.commands import ROOT, UNREACHABLE

HEAVY = {"alembic", "dask", "distributed", "numba", "numpy", "zarr"}
"""Libraries that take long to import, and that no quick command needs."""
REMOTE = {
    "upload": ["film.zip"],
    "recover": ["c"],
    "status": ["j"],
    "wait": ["j"],
    "pause": ["j"],
    "resume": ["j"],
    "cancel": ["j"],
    "composite": ["m", "backdrop.png", "-o", "composite.png"],
    "export": ["m", "-o", "matte.zip"],
    "share": ["m"],
    "import": ["matte.zip"],
    "layers": ["m", "layers"],
    "list": ["mattes"],
    "delete": ["mattes", "m"],
}
"""Arguments of every command that does nothing but talk to a service."""


def imported(*arguments: str, folder: Path) -> set[str]:
    """The top-level modules that a command imports while it runs."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-X", "importtime", "-m", "services", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder, env=environment)
    assert done.returncode in (0, 3), done.stderr[-2000:]
    return {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}


@pytest.mark.parametrize("command", [["--help"], ["serve", "--help"], ["demo", "--help"]], ids=" ".join)
def test_help_imports_nothing_heavy(command: list[str], tmp_path: Path) -> None:
    assert "click" in (found := imported(*command, folder=tmp_path))
    assert not found & (HEAVY | {"sqlalchemy", "httpx2"})


def test_listing_keys_imports_nothing_heavy(tmp_path: Path) -> None:
    imported("keys", "make", "lab", folder=tmp_path)  # makes the database, with alembic
    assert "sqlalchemy" in (found := imported("keys", "list", folder=tmp_path))
    assert not found & (HEAVY | {"pydantic"})


@pytest.mark.parametrize("name", [str(command.name) for command in (*jobs.COMMANDS, *mattes.COMMANDS)])
def test_commands_that_talk_to_a_service_import_nothing_heavy(name: str, tmp_path: Path) -> None:
    for file in ("film.zip", "matte.zip", "backdrop.png"):
        (tmp_path / file).write_bytes(b"any")
    assert "httpx2" in (found := imported(name, *REMOTE[name], *UNREACHABLE, folder=tmp_path))
    assert not found & (HEAVY | {"sqlalchemy", "pydantic"})


def test_what_commands_know_without_importing_the_service_is_what_it_has() -> None:
    assert mattes.OF_PLATE == layers.OF_PLATE
    assert (keys.SCOPES, keys.DEFAULT) == (api_keys.SCOPES, owners.DEFAULT)
