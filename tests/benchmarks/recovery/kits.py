"""Shared parts of the benchmarks: a kit of traced scenes, a service to measure, tables."""

import argparse
import importlib.util
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from services.cli.demo_run import service
from services.client import Client


def parser_of(documentation: str | None) -> argparse.ArgumentParser:
    """An argument parser for KIT and SCENES, to be extended."""
    parser = argparse.ArgumentParser(
        description=documentation, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kit", type=Path)
    parser.add_argument("scenes", type=Path)
    return parser


def load(kit: Path) -> ModuleType:
    """Import a kit from its path."""
    spec = importlib.util.spec_from_file_location("kit", kit)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kit"] = module
    spec.loader.exec_module(module)
    return module


@contextmanager
def served(workers: int) -> Iterator[tuple[Client, Path]]:
    """A client of a running service, and a temporary folder with its data."""
    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder, "data"), workers) as url,
        Client(url) as client,
    ):
        yield client, Path(folder)


def show(row: dict[str, Any]) -> None:
    """Print a row in the widths of its columns."""
    print("  ".join(f"{value!s:>{max(8, len(name))}}" for name, value in row.items()), flush=True)
