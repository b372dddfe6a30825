"""The dask cluster that does the work: processes of this machine."""

from collections.abc import Iterator
from contextlib import contextmanager

from distributed import Client, LocalCluster

from services.settings import Settings


@contextmanager
def open_cluster(settings: Settings) -> Iterator[Client]:
    """Start worker processes on loopback, and end them at the end.

    Yields
    ------
    distributed.Client
        Synchronous; may be used from any thread.
    """
    scratch = settings.data.resolve() / "scratch"
    with (
        LocalCluster(
            n_workers=settings.workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            local_directory=str(scratch),
            silence_logs=30,
            death_timeout="60s",  # what a worker may take to start on a busy machine
            # Importing the kernels takes seconds: not out of the first job's time.
            preload="workflows.jobs",
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client
