"""The commands of `envmatte` that prepare an installation: certificates of a cluster."""

from pathlib import Path

import click

from services.cli.options import as_json
from services.cli.output import example, print_summary


@click.command(epilog=example("envmatte certs certs"))
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path), metavar="DIR")
@as_json
def certs(folder: Path, as_json: bool) -> None:
    """Make the certificates of a cluster in DIR.

    Copy the folder to every host of the cluster and name it with --certs. Anyone with these certificates can run
    arbitrary code on all machines of the cluster. A complete set that is there already is kept.
    """
    from services.runtime.certificates import make

    made = make(folder)
    summary = f"{folder}: made; copy it to every host" if made else f"{folder}: exists already, and is kept"
    print_summary({"folder": str(folder), "made": made}, as_json, summary)


COMMANDS = (certs,)
