"""Connections to a dask scheduler: one that runs elsewhere, or that of the embedded cluster."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import cache, partial

from distributed import Client
from distributed.comm import connect as open_comm
from distributed.security import Security
from tornado.ioloop import IOLoop

from services.cluster.dispatcher import Dispatcher
from services.cluster.embedded import Scale, embedded
from services.settings import CoordinatorSettings
from storage.errors import Unavailable

PATIENCE = 5
"""Seconds that a scheduler may take to answer a new client."""


async def reach(address: str, security: Security | None, role: str = "client") -> None:
    """Check that a scheduler answers.

    Raises
    ------
    OSError
        If none does within some seconds. dask alone would wait for ever for one that accepts a connection and then
        stays silent.
    """
    args = (security or Security()).get_connection_args(role)
    comm = await asyncio.wait_for(open_comm(address, timeout=PATIENCE, **args), PATIENCE + 1)
    comm.abort()


def connect(address: str, security: Security | None) -> Client:
    """Connect to a running scheduler.

    Parameters
    ----------
    address : str
        ``tls://HOST:PORT``, or ``tcp://HOST:PORT`` without TLS.
    security : distributed.security.Security or None
        For TLS, as `services.runtime.certificates.security_of` makes it.

    Returns
    -------
    distributed.Client
        Synchronous; may be used from any thread.

    Raises
    ------
    Unavailable
        If no scheduler answers within some seconds, or it does not accept these certificates.
    """
    try:
        asyncio.run(reach(address, security))
        return Client(address, security=security, timeout=PATIENCE, set_as_default=False, loop=_loop())
    except OSError as error:  # a time-out too
        raise Unavailable(
            f"no scheduler answers at {address}: check that `envmatte scheduler` runs there, can be reached from here "
            "and has the same certificates"
        ) from error


@cache
def _loop() -> IOLoop:
    """The loop of all clients, in one thread: a client that got no answer would leave a loop of its own running."""
    running: Future[IOLoop] = Future()

    async def run() -> None:
        running.set_result(IOLoop.current())
        await asyncio.Event().wait()

    threading.Thread(target=asyncio.run, args=(run(),), name="clients", daemon=True).start()
    return running.result()


@contextmanager
def dispatcher_of(settings: CoordinatorSettings, installation: str | None) -> Iterator[Dispatcher]:
    """A dispatcher for the cluster that the settings name, reachable yet or not, or for an embedded one.

    Parameters
    ----------
    installation : str, optional
        What workers recognise the store by.
    """
    if settings.cluster:
        remote = partial(connect, settings.cluster, settings.security())
        with Dispatcher(remote, settings.store_url, installation=installation) as dispatcher:
            yield dispatcher
    else:
        with embedded(settings) as cluster:
            local = partial(Client, cluster, set_as_default=False)
            scale = Scale(cluster.scale, settings.workers)
            with Dispatcher(local, settings.store_url, scale, installation) as dispatcher:
                yield dispatcher
