"""`envmatte verify`, `backup` and `restore`: for whoever runs the service, who has its database and its store."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import click

from services.cli.output import as_json, example, say
from services.cli.processes import given_of, refusals_told
from services.cli.progress import Progress

if TYPE_CHECKING:
    from sqlalchemy import Engine

    from services.settings import Settings
    from storage.objects.store import Objects

SHOWN = 50
"""Findings that are printed for people, at most: of a store that is lost there are as many as objects."""
F = Callable[..., Any]


def _where(command: F) -> F:
    """The options that name an installation, which count as those of `envmatte serve`."""
    for option in (
        click.option("--store", help="Its store, if that is another: s3://BUCKET/PREFIX or file:///FOLDER."),
        click.option(
            "--database", help="Its database, if that is another: postgresql://USER:PASSWORD@HOST/NAME."
        ),
        click.option("--data", type=click.Path(path_type=Path), help="Folder of the service's data."),
    ):
        command = option(command)
    return command


@contextmanager
def _opened(given: dict[str, Any]) -> Iterator[tuple["Settings", "Engine", "Objects"]]:
    """The database and the store of an installation that is there, as they are."""
    from services.settings import Settings
    from storage.maintenance.row_dump import open_without_upgrade
    from storage.objects.store import Objects

    with refusals_told():
        settings = Settings(**given_of(given))
        engine = open_without_upgrade(settings.database_url)
        try:
            yield settings, engine, Objects(settings.store_url)
        finally:
            engine.dispose()


def _place(context: click.Context, parameter: click.Parameter, text: str) -> str:
    """A folder, or the URL of a bucket, as `storage.objects.store.Objects` takes it."""
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
@_where
@as_json
def verify(as_json: bool, **given: Any) -> None:
    """Check every stored byte against its checksum.

    Reads all that the database says is stored, and lists what is missing, damaged, or there without belonging to
    anything, each with what to do about it; exit code 1 if there is any. It may run while the service does: what is
    deleted meanwhile is no fault, what is being written is left out.
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
            click.echo(f"and {len(report.findings) - SHOWN} more, which --json lists")
        click.echo(
            f"{report.things} things, {read['objects']} objects, {_size(read['bytes'])} read", err=True
        )
        if report.busy:
            click.echo(f"{report.busy} are being written, and were left out", err=True)
        if read["unchecked"]:
            click.echo(
                f"{read['unchecked']} objects, {_size(read['unchecked_bytes'])}, have no checksum, for they were "
                "stored before there were any: that they can be read is all that is known of them",
                err=True,
            )
        click.echo("all is as it was written" if not report.findings else f"{len(report.findings)} found")
    if report.findings:
        sys.exit(1)


@click.command(epilog=example("envmatte backup /mnt/backups/monday --data data"))
@click.argument("target", callback=_place)
@_where
@as_json
def backup(target: str, as_json: bool, **given: Any) -> None:
    """Copy a whole installation to TARGET, an empty folder or s3://BUCKET/PREFIX, while it runs.

    The database as it is at the start, and all that it says is stored; every byte is checked on its way. Settings and
    certificates are not in it.
    """
    from storage.maintenance.backup import back_up
    from storage.objects.store import Objects

    with _opened(given) as (_, engine, objects), _shown("backup") as progress:
        made = back_up(engine, objects, Objects(target), version("envmatte"), progress)
    told = f"{made['objects']} objects, {_size(made['bytes'])}, {made['rows']} rows"
    say({"target": target, **made, "told": told}, as_json, "told")


@click.command(epilog=example("envmatte restore /mnt/backups/monday --data data"))
@click.argument("source", callback=_place)
@_where
@as_json
def restore(source: str, as_json: bool, **given: Any) -> None:
    """Bring a backup back from SOURCE, a folder or s3://BUCKET/PREFIX, into an empty installation.

    Database and store may be of other kinds than those it was made of. Every byte is checked on its way. It comes whole
    or not at all; then `envmatte serve` goes on with the jobs that ran.
    """
    from services.runtime.data_lock import lock_data
    from services.settings import Settings
    from storage.database import dialects
    from storage.errors import NotFound
    from storage.maintenance.restore import restore
    from storage.objects.store import Objects

    with refusals_told():
        folder = Path(url2pathname(urlsplit(source).path))
        if source.startswith("file:") and not folder.is_dir():  # which opening would make
            raise NotFound(f"there is no folder {folder}: name the one that `envmatte backup` wrote to")
        settings = Settings(**given_of(given))
        settings.data.mkdir(parents=True, exist_ok=True)
        engine = dialects.make_engine(settings.database_url)
        try:
            with lock_data(settings.data) if settings.alone else nullcontext(), _shown("restore") as progress:
                came = restore(Objects(source), engine, Objects(settings.store_url), progress)
        finally:
            engine.dispose()
    told = f"{came['objects']} objects, {_size(came['bytes'])}, {came['rows']} rows"
    say({"source": source, **came, "told": told}, as_json, "told")


COMMANDS = (verify, backup, restore)
