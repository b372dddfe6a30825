"""Options that several commands share."""

from pathlib import Path
from typing import Any

import click

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
