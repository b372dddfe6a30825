"""The commands of `envmatte` that run processes of a service, and the settings in their help."""

import signal
from pathlib import Path
from typing import Any

import click

from services.cli.options import drop_unset
from services.cli.output import example
from services.runtime.memory import no_collections
from storage.errors import InvalidInput

ENDING = signal.SIGTERM, signal.SIGHUP
"""What a supervisor sends, and a terminal that is closed. Other commands end at them as at Ctrl-C."""
_certs = click.option(
    "--certs",
    type=click.Path(path_type=Path),
    help="Folder of the cluster's certificates, made by `envmatte certs`.",
)


class _ProcessCommand(click.Command):
    """A command that runs a process. Its help ends with the settings of that."""

    def __init__(self, *args: Any, settings: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._settings = settings

    def invoke(self, context: click.Context) -> Any:
        """Run the command; settings that its process can't work with are a wrong command line."""
        for number in ENDING:  # once it has started, it ends in an order of its own
            if signal.getsignal(number) == signal.default_int_handler:
                signal.signal(number, signal.SIG_DFL)
        try:
            return super().invoke(context)
        except InvalidInput as error:
            raise click.UsageError(error.detail) from error

    def format_epilog(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_epilog(context, formatter)
        from services import settings

        described = settings.describe_settings(getattr(settings, self._settings))
        with formatter.section("Settings"):
            formatter.write_text(
                "Environment variables, or lines of the file .env in the working directory. The environment wins over "
                "the file, and an option above wins over both."
            )
        for group in dict.fromkeys(one.group for one in described):
            with formatter.section(group):
                formatter.write_dl(
                    [
                        (one.variable, f"{one.description}  [default: {one.default}]")
                        for one in described
                        if one.group == group
                    ]
                )


@click.command(
    cls=_ProcessCommand, settings="Settings", epilog=example("envmatte serve --data data --port 8000")
)
@click.option("--data", type=click.Path(path_type=Path), help="Folder of the database and everything stored.")
@click.option("--host", help="Address to listen on.")
@click.option("--port", type=int, help="Port to listen on; 0 takes a free one.")
@click.option("--workers", type=int, help="Worker processes.")
@click.option("--cluster", help="Scheduler of a cluster to use: tls://HOST:PORT.")
@_certs
@click.option(
    "--database",
    help="Database to use: postgresql://USER@HOST/NAME. A URL with a password goes into ENVMATTE_DATABASE, because "
    "other users can list commands.",
)
@click.option("--store", help="Store to use: s3://BUCKET/PREFIX or file:///FOLDER.")
def serve(**given: Any) -> None:
    """Run the service: API and web app, with database, store and workers on this machine unless others are named."""
    with no_collections():
        from services.cluster.dask_config import configure_dask
        from services.cluster.forkserver import PRELOAD, start_forkserver
        from services.runtime.kernel_cache import require_kernel_cache
        from services.settings import Settings

        settings = Settings(**drop_unset(given))
        require_kernel_cache()
        configure_dask()  # which says how processes are started
        if settings.coordinate and settings.cluster is None:
            start_forkserver(PRELOAD)  # at the same time as this process imports the rest
        from services.server import serve as run

    run(settings)


@click.command(
    cls=_ProcessCommand,
    settings="CoordinatorSettings",
    epilog=example("envmatte coordinator --cluster tls://HOST:8786 --certs certs"),
)
@click.option("--cluster", help="Scheduler to hand work to: tls://HOST:PORT.")
@_certs
@click.option(
    "--database",
    help="Database that the API uses: postgresql://USER@HOST/NAME. A URL with a password goes into ENVMATTE_DATABASE.",
)
@click.option("--store", help="Store that all processes use: s3://BUCKET/PREFIX or file:///FOLDER.")
def coordinator(**given: Any) -> None:
    """Run a coordinator without an API. Of several, one runs the jobs, and another takes over when it dies."""
    from services.runtime.kernel_cache import require_kernel_cache

    require_kernel_cache()
    from services.server import coordinate
    from services.settings import CoordinatorSettings

    coordinate(CoordinatorSettings(**drop_unset(given)))


@click.command(
    cls=_ProcessCommand,
    settings="SchedulerSettings",
    epilog=example("envmatte scheduler --host 0.0.0.0 --certs certs"),
)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port", type=int, default=8786, show_default=True, help="Port to listen on; 0 takes a free one."
)
@_certs
def scheduler(host: str, port: int, **given: Any) -> None:
    """Run the scheduler of a cluster, for workers and services on several machines.

    With certificates it uses TLS; without, it listens on loopback only.
    """
    from services.cluster.scheduler import schedule
    from services.settings import SchedulerSettings

    schedule(SchedulerSettings(**drop_unset(given)), host, port)


@click.command(
    cls=_ProcessCommand,
    settings="ClusterSettings",
    epilog=example("envmatte worker --cluster tls://HOST:8786 --certs certs"),
)
@click.option("--cluster", help="Scheduler to work for: tls://HOST:PORT, or tcp://127.0.0.1:PORT.")
@_certs
@click.option("--workers", type=int, help="Worker processes. Default: one per core.")
@click.option("--host", help="Address to listen on. Default: the one from which the scheduler is reached.")
def worker(host: str | None, **given: Any) -> None:
    """Run workers of a cluster on this machine.

    They wait until the scheduler can be reached, and join it again after it was away.
    """
    from services.cluster.worker import work
    from services.runtime.kernel_cache import require_kernel_cache
    from services.settings import ClusterSettings

    require_kernel_cache()
    work(ClusterSettings(**drop_unset(given)), host)


COMMANDS = (serve, coordinator, scheduler, worker)
