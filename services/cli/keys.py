"""`envmatte keys`: for whoever runs the service, who has its database."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from services.cli.output import as_json, example
from services.cli.processes import given_of, refusals_told

if TYPE_CHECKING:
    from sqlalchemy import Engine

SCOPES = ("read", "write", "admin")
_data = click.option("--data", type=click.Path(path_type=Path), help="Folder of the service's data.")
_database = click.option(
    "--database", help="Its database, if that is another: postgresql://USER:PASSWORD@HOST/NAME."
)


@contextmanager
def _opened(given: dict[str, Any]) -> Iterator["Engine"]:
    from services.settings import Settings
    from storage.database.engine import open_engine

    with refusals_told():
        settings = Settings(**given_of(given))
        if settings.database is None:
            settings.data.mkdir(parents=True, exist_ok=True)
        engine = open_engine(settings.database_url)
        try:
            yield engine
        finally:
            engine.dispose()


@click.group(epilog=example("envmatte keys list"))
def keys() -> None:
    """Make, list and revoke API keys, in the service's database: while it runs, or before.

    From the first key on, every call takes one.
    """


@keys.command(epilog=example("envmatte keys make lab --owner alice"))
@click.argument("name")
@click.option("--owner", default="default", show_default=True, help="Whose things the key is for.")
@click.option(
    "--scope",
    type=click.Choice(SCOPES),
    default="write",
    show_default=True,
    help="read: to look; write: to make and delete as well; admin: to see the whole service as well, its cluster and "
    "figures, but no other owner's things.",
)
@_data
@_database
@as_json
def make(name: str, owner: str, scope: str, as_json: bool, **given: Any) -> None:
    """Make a key, and show it: this once, for only a hash of it is kept."""
    from storage.database.engine import writing
    from storage.records import api_keys

    with _opened(given) as engine, writing(engine) as connection:
        key = api_keys.create(connection, name, owner, scope)
    made = {"name": name, "owner": owner, "scope": scope, "key": key}
    click.echo(json.dumps(made, indent=2) if as_json else key)


@keys.command("list", epilog=example("envmatte keys list --json"))
@_data
@_database
@as_json
def list_(as_json: bool, **given: Any) -> None:
    """List keys, oldest first: name, owner, scope, when they were made and revoked."""
    from storage.database.engine import reading
    from storage.records import api_keys

    with _opened(given) as engine, reading(engine) as connection:
        rows = api_keys.list_all(connection)
    found = [
        {
            "name": row.name,
            "owner": row.owner,
            "scope": row.scope,
            "created_at": _time(row.created_at),
            "revoked_at": _time(row.revoked_at),
        }
        for row in rows
    ]
    if as_json:
        click.echo(json.dumps({"keys": found}, indent=2))
        return
    for one in found:
        click.echo("\t".join(str(value or "") for value in one.values()).rstrip())


@keys.command(epilog=example("envmatte keys revoke lab"))
@click.argument("name")
@_data
@_database
@as_json
def revoke(name: str, as_json: bool, **given: Any) -> None:
    """Revoke a key: it stops working at once."""
    from storage.database.engine import writing
    from storage.records import api_keys

    with _opened(given) as engine, writing(engine) as connection:
        api_keys.revoke(connection, name)
    click.echo(json.dumps({"name": name, "revoked": True}, indent=2) if as_json else f"{name}: revoked")


def _time(seconds: float | None) -> str | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
