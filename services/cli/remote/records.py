"""Commands for all that a service stores: list it, delete it."""

import json

import click

from services.cli import options
from services.cli.output import example, print_summary

KINDS = ("captures", "jobs", "mattes")
_kind = click.argument("kind", type=click.Choice(KINDS))


@click.command("list", epilog=example("envmatte list mattes", "envmatte list captures --name glass"))
@_kind
@click.option("--name", help="Those whose name contains this, in upper or lower case; not of jobs.")
@click.option("--state", help="Those in this state, such as ready, running or failed.")
@options.remote
def list_(kind: str, name: str | None, state: str | None, url: str, key: str | None, as_json: bool) -> None:
    """List captures, jobs or mattes, newest first: id, state, when it was made, and name."""
    if name and kind == "jobs":
        raise click.UsageError("jobs are not searched by name: omit --name")
    wanted = {field: value for field, value in (("name", name), ("state", state)) if value}
    with options.client(url, key) as client:
        found = [record.answer for record in getattr(client, kind)(**wanted)]
    if as_json:
        click.echo(json.dumps({kind: found}, indent=2))
        return
    for one in found:
        click.echo("\t".join(one[field] or "" for field in ("id", "state", "created_at", "name")).rstrip())


@click.command(epilog=example("envmatte delete mattes MATTE"))
@_kind
@click.argument("ids", nargs=-1, required=True, metavar="ID...")
@options.remote
def delete(kind: str, ids: tuple[str, ...], url: str, key: str | None, as_json: bool) -> None:
    """Delete captures, jobs that have ended, or mattes, each by its id.

    Mattes that were recovered from a capture stay when it is deleted. What a job uses can't be deleted.
    """
    with options.client(url, key) as client:
        for id in ids:
            if kind == "captures":
                client.delete(client.capture(id))
            elif kind == "jobs":
                client.delete(client.job(id))
            else:
                client.delete(client.matte(id))
    print_summary({"deleted": list(ids)}, as_json, f"{len(ids)} deleted")


COMMANDS = (list_, delete)
