"""`envmatte scheduler`: the dask scheduler of a cluster, which hands tasks to workers and keeps nothing."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from distributed import Scheduler

from services.cluster.connect import SCHEDULER
from services.runtime.addresses import is_loopback
from services.runtime.certificates import security_of
from services.runtime.logs import log
from services.runtime.process import keep_open
from services.settings import ClusterSettings
from storage.errors import Conflict, InvalidInput


def schedule(settings: ClusterSettings, host: str, port: int) -> None:
    """Schedule until SIGTERM; prints the address as soon as it listens there.

    Parameters
    ----------
    settings : ClusterSettings
        Of which the certificates count. Without any there is no TLS.
    host : str
        Address to listen on.
    port : int
        0 takes a free one.

    Raises
    ------
    InvalidInput
        If it should listen on other than loopback without certificates, or they can't be used.
    Conflict
        If it can't listen there.
    KeyboardInterrupt
        At SIGINT.
    """
    log(settings.log, settings.log_level, "scheduler")
    certs = settings.certificates
    if certs is None and not is_loopback(host):
        raise InvalidInput(
            f"asked to listen on {host} without TLS, where whoever reaches it may run what he likes: make certificates "
            "with `envmatte certs DIR`, give every process of the cluster a copy with --certs, or listen on 127.0.0.1"
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
            raise Conflict(f"can't listen on {host}, port {port}: {error.__cause__.strerror}") from error
        print(f"envmatte schedules at {running.address}", flush=True)
        try:
            yield
        finally:
            await running.close()

    keep_open(scheduler())
