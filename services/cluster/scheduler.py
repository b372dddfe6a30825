"""`envmatte scheduler`: the dask scheduler of a cluster, which hands tasks to workers and stores nothing."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from distributed import Scheduler

from services.cluster.dask_config import SCHEDULER, configure_dask
from services.runtime.addresses import cannot_listen, is_loopback
from services.runtime.certificates import security_of
from services.runtime.logs import configure_logging
from services.runtime.signals import run_until_signal
from services.settings import SchedulerSettings, warn_of_unknown
from storage.errors import InvalidInput


def schedule(settings: SchedulerSettings, host: str, port: int) -> None:
    """Run a scheduler until SIGTERM; prints its address as soon as it listens.

    Parameters
    ----------
    settings : SchedulerSettings
        Only the certificates are used. Without any there is no TLS.
    host : str
        Address to listen on.
    port : int
        Port to listen on; 0 takes a free one.

    Raises
    ------
    InvalidInput
        If it would listen beyond loopback without certificates, or they can't be used.
    Conflict
        If it can't listen there.
    KeyboardInterrupt
        At SIGINT.
    """
    configure_logging(settings.log, settings.log_level, "scheduler")
    warn_of_unknown()
    configure_dask()
    certs = settings.certificates
    if certs is None and not is_loopback(host):
        raise InvalidInput(
            f"without TLS, anyone who reaches {host} could run arbitrary code on the cluster. Make certificates with "
            "`envmatte certs DIR` and give every process of the cluster a copy with --certs, or listen on 127.0.0.1"
        )
    security = security_of(certs) if certs else None

    @asynccontextmanager
    async def scheduler() -> AsyncIterator[None]:
        try:
            running = await Scheduler(
                host=host,
                port=port,
                protocol="tls" if security else "tcp",
                security=security,
                **SCHEDULER,
            )
        except RuntimeError as error:
            if not isinstance(error.__cause__, OSError):
                raise
            raise cannot_listen(host, port, error.__cause__) from error
        print(f"envmatte schedules at {running.address}", flush=True)
        try:
            yield
        finally:
            await running.close()

    run_until_signal(scheduler())
