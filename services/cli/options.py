"""Options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from services.client import Client

F = TypeVar("F", bound=Callable[..., Any])

InputFile = click.Path(exists=True, dir_okay=False, path_type=Path)
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


def drop_unset(options: dict[str, Any]) -> dict[str, Any]:
    """The options that were given; the environment decides about all others."""
    return {name: value for name, value in options.items() if value is not None}


def remote(command: F) -> F:
    """Add the options of every command that talks to a service."""
    url = click.option(
        "--url",
        envvar="ENVMATTE_URL",
        default="http://127.0.0.1:8000",
        show_default=True,
        help="URL of the service.",
    )
    key = click.option("--key", envvar="ENVMATTE_KEY", help="API key, if the service requires one.")
    return url(key(as_json(command)))


def client(url: str, key: str | None) -> Client:
    """A connection to the service that the options of `remote` name."""
    try:
        return Client(url, key)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--url") from error
