"""`envmatte verify`, `backup` and `restore`: maintenance of a database and its store."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from services.cli import options
from services.cli.options import as_json, drop_unset
from services.cli.output import example, print_summary
from services.cli.progress import Progress

if TYPE_CHECKING:
    from sqlalchemy import Engine

    from services.settings import Settings
    from storage.objects.store import Objects

SHOWN = 50
"""Findings that are printed without --json, at most. A lost store has as many as there were objects."""
F = Callable[..., Any]


def _installation(command: F) -> F:
    """Add the options that name an installation, with the meaning they have for `envmatte serve`."""
    return options.data(options.database(options.store(command)))


@contextmanager
def _opened(given: dict[str, Any]) -> Iterator[tuple["Settings", "Engine", "Objects"]]:
    """The database and the store of an existing installation; the schema is not upgraded."""
    from services.settings import Settings
    from storage import installation
    from storage.maintenance.row_dump import open_without_upgrade

    settings = Settings(**drop_unset(given))
    engine = open_without_upgrade(settings.database_url)
    try:
        # In another store all would be missing, with advice to upload it again.
        yield settings, engine, installation.open_store(engine, settings.store_url)
    finally:
        engine.dispose()


def _to_url(context: click.Context, parameter: click.Parameter, text: str) -> str:
    """The URL of a folder or a bucket, as `storage.objects.store.Objects` takes it."""
    url = urlsplit(text)
    if (url.scheme == "s3" and url.netloc) or (url.scheme == "file" and url.path):
        return text
    if "://" in text:
        raise click.BadParameter("give it as a folder, or as s3://BUCKET/PREFIX")
    return Path(text).resolve().as_uri()


def _size(size: float) -> str:
    return f"{size / 1e6:.1f} MB"


@contextmanager
def _shown(what: str) -> Iterator[Callable[[float, int], None]]:
    with Progress(what) as bar:
        yield lambda share, size: bar.show(share, _size(size))


@click.command(epilog=example("envmatte verify --data data"))
@_installation
@as_json
def verify(as_json: bool, **given: Any) -> None:
    """Check every stored byte against its checksum.

    Reads everything that the database lists as stored. Prints what is missing, damaged or belongs to nothing, each
    with what to do about it, and then exits with code 1. The service may run meanwhile: objects that are being
    written are skipped, and those deleted meanwhile are not reported.
    """
    from storage.maintenance.verify import verify

    with _opened(given) as (_, engine, objects), _shown("verify") as progress:
        report = verify(engine, objects, progress)
    read = report.read
    if as_json:
        click.echo(json.dumps(asdict(report), indent=2))
    else:
        for one in report.findings[:SHOWN]:
            click.echo(f"{one.what}: {one.object}: {one.remedy}")
        if len(report.findings) > SHOWN:
            click.echo(f"and {len(report.findings) - SHOWN} more; --json lists all")
        click.echo(
            f"{report.things} things, {read['objects']} objects, {_size(read['bytes'])} read", err=True
        )
        if report.busy:
            click.echo(f"{report.busy} are being written, and were skipped", err=True)
        if read["unchecked"]:
            click.echo(
                f"{read['unchecked']} objects, {_size(read['unchecked_bytes'])}, have no checksum: an early version "
                "stored them. They could be read, but not checked",
                err=True,
            )
        click.echo("no damage found" if not report.findings else f"{len(report.findings)} problems found")
    if report.findings:
        sys.exit(1)


@click.command(epilog=example("envmatte backup /mnt/backups/monday --data data"))
@click.argument("target", callback=_to_url)
@_installation
@as_json
def backup(target: str, as_json: bool, **given: Any) -> None:
    """Copy a whole installation to TARGET, an empty folder or s3://BUCKET/PREFIX. The service may run meanwhile.

    The backup holds the database as it is at the start, and everything that it lists as stored. Every byte is checked
    on the way. Settings and certificates are not included.
    """
    from importlib.metadata import version

    from storage.maintenance.backup import back_up
    from storage.objects.store import Objects

    with _opened(given) as (_, engine, objects), _shown("backup") as progress:
        made = back_up(engine, objects, Objects(target), version("envmatte"), progress)
    print_summary({"target": target, **made}, as_json, _count(made))


@click.command(epilog=example("envmatte restore /mnt/backups/monday --data data"))
@click.argument("source", callback=_to_url)
@_installation
@as_json
def restore(source: str, as_json: bool, **given: Any) -> None:
    """Restore a backup from SOURCE, a folder or s3://BUCKET/PREFIX, into an empty installation.

    Database and store may be of other kinds than those the backup was made from. Every byte is checked on the way. The
    restore is complete or leaves nothing. `envmatte serve` then continues the jobs that were running.
    """
    from services.runtime.data_folder import lock_data, make_data
    from services.settings import Settings
    from storage.database import dialects
    from storage.errors import NotFound
    from storage.maintenance.restore import restore
    from storage.objects.store import Objects, folder_of

    folder = folder_of(source)
    if folder is not None and not folder.is_dir():  # opening it would create it
        raise NotFound(f"there is no folder {folder}: name the one that `envmatte backup` wrote to")
    settings = Settings(**drop_unset(given))
    make_data(settings.data)
    engine = dialects.make_engine(settings.database_url)
    try:
        with lock_data(settings.data) if settings.alone else nullcontext(), _shown("restore") as progress:
            restored = restore(Objects(source), engine, Objects(settings.store_url), progress)
    finally:
        engine.dispose()
    print_summary({"source": source, **restored}, as_json, _count(restored))


def _count(copied: dict[str, int]) -> str:
    return f"{copied['objects']} objects, {_size(copied['bytes'])}, {copied['rows']} rows"


COMMANDS = (verify, backup, restore)
