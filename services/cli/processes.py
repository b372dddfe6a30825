"""The commands of `envmatte` by which processes of a service are run."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from services.cli.output import as_json, example, say

if TYPE_CHECKING:
    from pydantic import ValidationError

_certs = click.option(
    "--certs",
    type=click.Path(path_type=Path),
    help="Folder of the cluster's certificates, see `envmatte certs`.",
)


def given_of(options: dict[str, Any]) -> dict[str, Any]:
    """The options that were given: for all others the environment counts."""
    return {name: value for name, value in options.items() if value is not None}


@contextmanager
def refusals_told() -> Iterator[None]:
    """What a process of the service refuses becomes a message and an exit code."""
    from pydantic import ValidationError

    from storage.errors import EnvmatteError

    try:
        yield
    except ValidationError as error:
        raise click.UsageError(first_of(error)) from error
    except EnvmatteError as error:
        raise click.ClickException(error.detail) from error


def first_of(error: "ValidationError") -> str:
    """The first thing that is wrong, in words."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))} {first['msg']}".strip()


@click.command(epilog=example("envmatte serve --data data --port 8000"))
@click.option("--data", type=click.Path(path_type=Path), help="Folder of the database and everything stored.")
@click.option("--host", help="Address to listen on.")
@click.option("--port", type=int, help="Port to listen on; 0 takes a free one.")
@click.option("--workers", type=int, help="Worker processes.")
@click.option("--cluster", help="Scheduler of a cluster to use instead: tls://HOST:PORT.")
@_certs
@click.option("--database", help="Database to use: postgresql://USER:PASSWORD@HOST/NAME.")
@click.option("--store", help="Store to use: s3://BUCKET/PREFIX or file:///FOLDER.")
def serve(**given: Any) -> None:
    """Run the service: API, database, store and a cluster of this machine, unless others are named.

    Every setting is an environment variable ENVMATTE_… too, and a line in .env; an option here wins.
    """
    from services.cluster.dask_config import configure_dask
    from services.cluster.forkserver import DECODING, PRELOAD, start_forkserver
    from services.settings import Settings

    with refusals_told():
        settings = Settings(**given_of(given))
        own = settings.coordinate and settings.cluster is None  # a cluster, whose workers are this process's
        configure_dask()  # which says how processes are started
        # At the same time as this process imports the rest.
        start_forkserver(DECODING, *([PRELOAD] if own else []))
        from services.server import serve as run

        run(settings)


@click.command(epilog=example("envmatte coordinator --cluster tls://HOST:8786 --certs certs"))
@click.option("--cluster", help="Scheduler to hand work to: tls://HOST:PORT.")
@_certs
@click.option("--database", help="Database that the API uses: postgresql://USER:PASSWORD@HOST/NAME.")
@click.option("--store", help="Store that all of them use: s3://BUCKET/PREFIX or file:///FOLDER.")
def coordinator(**given: Any) -> None:
    """Run a coordinator without an API: it drives jobs whenever no other coordinator does."""
    from services.server import coordinate
    from services.settings import Settings

    with refusals_told():
        coordinate(Settings(**given_of(given)))


@click.command(epilog=example("envmatte scheduler --host 0.0.0.0 --certs certs"))
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", type=int, default=8786, show_default=True, help="Port to listen on; 0 takes a free one."
)
@_certs
def scheduler(host: str, port: int, **given: Any) -> None:
    """Run the scheduler of a cluster, for workers and services of many machines.

    With certificates it speaks TLS; without it listens on loopback alone.
    """
    from services.cluster.scheduler import schedule
    from services.settings import ClusterSettings

    with refusals_told():
        schedule(ClusterSettings(**given_of(given)), host, port)


@click.command(epilog=example("envmatte worker --cluster tls://HOST:8786 --certs certs"))
@click.option("--cluster", help="Scheduler to work for: tls://HOST:PORT, or tcp://127.0.0.1:PORT.")
@_certs
@click.option("--workers", type=int, help="Worker processes. Default: one a core.")
@click.option("--host", help="Address to listen on. Default: that by which the scheduler is reached.")
def worker(host: str | None, **given: Any) -> None:
    """Run workers of a cluster on this machine.

    They wait for the scheduler as long as it takes, and join it again whenever it was gone.
    """
    from services.cluster.worker import work
    from services.settings import ClusterSettings

    with refusals_told():
        work(ClusterSettings(**given_of(given)), host)


@click.command(epilog=example("envmatte certs certs"))
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path), metavar="DIR")
@as_json
def certs(folder: Path, as_json: bool) -> None:
    """Make the certificates of a cluster in DIR.

    Every process of the cluster gets a copy with --certs; whoever has one may run what he likes on all of its
    machines. Where there is a whole set already it stays.
    """
    from services.runtime.certificates import make

    with refusals_told():
        made = make(folder)
    told = f"{folder}: made, copy it to every host" if made else f"{folder}: there already, and stays"
    say({"folder": str(folder), "made": made, "told": told}, as_json, "told")


COMMANDS = (serve, coordinator, scheduler, worker, certs)
