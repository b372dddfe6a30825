"""What commands write: examples in their help, results on standard output, files."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import click


def example(*lines: str, more: str = "") -> str:
    """The end of a command's help."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines) + (f"\n\n{more}" if more else "")


def print_result(result: Mapping[str, Any], as_json: bool, *names: str) -> None:
    """Print all of a result as JSON, or some of its values for the next command."""
    click.echo(json.dumps(result, indent=2) if as_json else " ".join(str(result[name]) for name in names))


def print_summary(result: Mapping[str, Any], as_json: bool, summary: str) -> None:
    """Print a result as JSON, with a summary, or the summary alone."""
    print_result({**result, "told": summary}, as_json, "told")


def write(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with open_whole(path) as file:
        file.write(data)


@contextmanager
def open_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears only once all of it is written."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            yield file
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
