"""Options that several commands share."""

import math
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import click

from services.client import Client, InvalidKey
from services.runtime.environment import read_environment

F = TypeVar("F", bound=Callable[..., Any])


class _InputFile(click.Path):
    """A file to read. A pipe can be read only once, and commands look at files first: it is copied to a file."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        file = cast(Path, super().convert(value, param, ctx))
        if file.is_file() or ctx is None:
            return file
        copy = Path(ctx.with_resource(tempfile.TemporaryDirectory(prefix="envmatte-input-")), file.name)
        with file.open("rb") as source, copy.open("wb") as target:
            shutil.copyfileobj(source, target)
        return copy


class _OutputFile(click.Path):
    """A file to write, whose folder is looked at before anything is computed for it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        file = cast(Path, super().convert(value, param, ctx))
        if not file.parent.is_dir():
            raise click.ClickException(
                f"{file} can't be written: there is no folder {file.parent}; make it first"
            )
        return file


class _Number(click.types.FloatParamType):
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


class NumberRange(click.FloatRange):
    """A finite number within a range: click has NaN within each."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        return super().convert(Number.convert(value, param, ctx), param, ctx)


InputFile = _InputFile(exists=True, dir_okay=False, path_type=Path)
Number = _Number()
"""A finite number."""
OutputFile = _OutputFile(dir_okay=False, path_type=Path)
as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
data = click.option("--data", type=click.Path(path_type=Path), help="Folder of the service's data.")
database = click.option(
    "--database",
    help="Database, if not in the data folder: postgresql://USER@HOST/NAME. A URL with a password goes into "
    "ENVMATTE_DATABASE, because other users can list commands.",
)
store = click.option(
    "--store", help="Store, if not in the data folder: s3://BUCKET/PREFIX or file:///FOLDER."
)


LOCAL = "http://127.0.0.1:8000"


def _url() -> str:
    return read_environment(("url",)).get("url", LOCAL)


def _key() -> str | None:
    return read_environment(("key",)).get("key")


key = click.option("--key", default=_key, help="API key, if the service requires one. Default: ENVMATTE_KEY.")


def drop_unset(options: dict[str, Any]) -> dict[str, Any]:
    """The options that were given; the environment decides about all others."""
    return {name: value for name, value in options.items() if value is not None}


def remote(command: F) -> F:
    """Add the options of every command that talks to a service."""
    url = click.option("--url", default=_url, help=f"URL of the service. Default: ENVMATTE_URL, or {LOCAL}.")
    return url(key(as_json(command)))


def client(url: str, key: str | None) -> Client:
    """A connection to the service that the options of `remote` name."""
    try:
        return Client(url, key)
    except ValueError as error:
        hint = "--key" if isinstance(error, InvalidKey) else "--url"
        raise click.BadParameter(str(error), param_hint=hint) from error
