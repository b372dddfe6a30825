"""`envmatte keys`: API keys, made in the service's database by those who run it."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from services.cli import options
from services.cli.options import as_json, drop_unset
from services.cli.output import example, print_result, print_summary
from storage.errors import InvalidInput

if TYPE_CHECKING:
    from sqlalchemy import Engine

SCOPES = ("read", "write", "admin")
DEFAULT = "default"
"""The owner of what is made without a key."""


@contextmanager
def _opened(given: dict[str, Any], *, made: bool = False) -> Iterator["Engine"]:
    """The service's database, which is made if there is none and it may be."""
    from services.runtime import environment
    from services.runtime.data_folder import make_data
    from storage.database.dialects import require_existing
    from storage.database.engine import open_engine

    found = environment.read_environment(("data", "database")) | drop_unset(given)
    data, database = Path(found.get("data", environment.DATA)), found.get("database")
    url = environment.database_url(data, database)
    try:
        if not made:
            require_existing(url)
        elif database is None:
            make_data(data)
        engine = open_engine(url)
    except InvalidInput as error:
        raise click.UsageError(error.detail) from error
    try:
        yield engine
    finally:
        engine.dispose()


@click.group(epilog=example("envmatte keys list"))
def keys() -> None:
    """Make, list and revoke API keys in the service's database.

    This works while the service runs and before it starts. Once there is a key, every request needs one.
    """


@keys.command(epilog=example("envmatte keys make lab --owner alice"))
@click.argument("name")
@click.option("--owner", default=DEFAULT, show_default=True, help="Owner of what is made with the key.")
@click.option(
    "--scope",
    type=click.Choice(SCOPES),
    default="write",
    show_default=True,
    help="read: view; write: also create and delete; admin: also view the cluster and the metrics. No scope gives "
    "access to what belongs to other owners.",
)
@options.data
@options.database
@as_json
def make(name: str, owner: str, scope: str, as_json: bool, **given: Any) -> None:
    """Make a key and print it. It is shown only once: the database keeps a hash of it."""
    from storage.database.dialects import display_url
    from storage.database.engine import writing
    from storage.records import api_keys

    with _opened(given, made=True) as engine:
        with writing(engine) as connection:
            key = api_keys.create(connection, name, owner, scope)
        click.echo(
            f"made in {display_url(engine.url)}: every request to its service needs a key now", err=True
        )
    if owner != DEFAULT:
        click.echo(
            f"what was made without a key belongs to {DEFAULT!r}, and {owner!r} does not see it", err=True
        )
    print_result({"name": name, "owner": owner, "scope": scope, "key": key}, as_json, "key")


@keys.command("list", epilog=example("envmatte keys list --json"))
@options.data
@options.database
@as_json
def list_(as_json: bool, **given: Any) -> None:
    """List keys, oldest first: name, owner, scope, and when they were made and revoked."""
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
@options.data
@options.database
@as_json
def revoke(name: str, as_json: bool, **given: Any) -> None:
    """Revoke a key. It stops working at once."""
    from storage.database.engine import writing
    from storage.records import api_keys

    with _opened(given) as engine, writing(engine) as connection:
        api_keys.revoke(connection, name)
        left = any(row.revoked_at is None for row in api_keys.list_all(connection))
    if not left:
        click.echo(
            "no key is left in the database, and requests still need one: `envmatte keys make NAME`", err=True
        )
    print_summary({"name": name, "revoked": True}, as_json, f"{name}: revoked")


def _time(seconds: float | None) -> str | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
