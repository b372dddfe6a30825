"""What the commands of `envmatte` have in common: examples, files written whole, what is printed."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import click

F = TypeVar("F", bound=Callable[..., Any])

as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")


def example(*lines: str, more: str = "") -> str:
    """The end of a command's help."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines) + (f"\n\n{more}" if more else "")


def say(found: Mapping[str, Any], as_json: bool, *names: str) -> None:
    """Print all there is as JSON, or some of it for the next command."""
    click.echo(json.dumps(found, indent=2) if as_json else " ".join(str(found[name]) for name in names))


def write(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with whole(path) as file:
        file.write(data)


@contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """A file that is written whole or not at all, so that an interrupt leaves nothing half done."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            yield file
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
