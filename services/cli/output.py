"""What commands write: examples in their help, results on standard output, files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from services.runtime.whole_files import is_standard_output, open_whole


def example(*lines: str, more: str = "") -> str:
    """The end of a command's help."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines) + (f"\n\n{more}" if more else "")


def print_result(result: Mapping[str, Any], as_json: bool, *names: str) -> None:
    """Print all of a result as JSON, or some of its values for the next command."""
    click.echo(json.dumps(result, indent=2) if as_json else " ".join(str(result[name]) for name in names))


def print_output(output: Path, as_json: bool) -> None:
    """Print the name of a file that was written, unless that is standard output, which has the file itself."""
    if not is_standard_output(output):
        print_result({"output": str(output)}, as_json, "output")


def print_summary(result: Mapping[str, Any], as_json: bool, summary: str) -> None:
    """Print a result as JSON, or a summary of it."""
    click.echo(json.dumps(result, indent=2) if as_json else summary)


def write(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with open_whole(path) as file:
        file.write(data)
