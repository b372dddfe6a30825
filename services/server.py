"""`envmatte serve`: the API, a coordinator and a cluster in one process tree; and `envmatte coordinator`."""

import gc
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from threading import Timer

from sqlalchemy import Engine

from services.cluster.connect import dispatcher_of
from services.cluster.dask_config import configure_dask
from services.coordinator.coordinator import Coordinator
from services.runtime import tracing
from services.runtime.addresses import bind, url_of
from services.runtime.data_folder import lock_data, make_data
from services.runtime.logs import configure_logging
from services.runtime.memory import limit_arenas, no_collections
from services.runtime.signals import exit_on_signal
from services.settings import CoordinatorSettings, Settings, warn_of_unknown
from services.webhooks.sender import Sender
from storage import installation
from storage.database.disk_reserve import keep_reserve
from storage.database.engine import open_engine
from storage.objects.store import Objects

GRACE = 3
"""Seconds that requests under way get to finish when the service is asked to stop; an upload may take hours."""
SWITCH_SECONDS = 0.0005
"""How long a thread keeps the interpreter from others that want it: a tenth of Python's default, so that the event loop
need not wait for ten of them. It costs what computes a few per cent."""
SILENCE = 5.0
"""Seconds without an answer of the store after which a start says what it waits for: a bucket is asked for a minute."""
logger = logging.getLogger(__name__)


def serve(settings: Settings) -> None:
    """Serve until interrupted. Jobs under way continue at the next start, or with another coordinator.

    Raises
    ------
    Conflict
        If another service uses the data folder, or it can't listen at its address.
    WrongStore
        If the store is not the one that the database belongs to.
    """
    # A coordinator alone needs none of these, and starts without them.
    with no_collections():
        import uvicorn

        from services.api.app import build_app
        from services.api.auth import require_keys_unless_loopback
        from services.api.http.browser_security import SecurityHeaders
        from services.api.http.shutdown import Server
        from services.api.http.slow_clients import Connection, raise_file_limit

    gc.freeze()  # a full collection of all modules would stop every thread for 0.1 s
    raise_file_limit()
    sys.setswitchinterval(SWITCH_SECONDS)
    with (
        # The port is bound before anything is made or started, so that one in use is reported at once.
        bind(settings.host, settings.port) as socket,
        _opened(settings, "service", mark=settings.coordinate) as (stack, engine, objects, id),
    ):
        require_keys_unless_loopback(settings, engine)
        app = build_app(settings, engine, objects)
        stack.callback(app.state.context.decoders.close)
        config = uvicorn.Config(
            SecurityHeaders(app),
            settings.host,
            settings.port,
            http=Connection,
            log_config=None,
            log_level="warning",
            lifespan="off",
            timeout_graceful_shutdown=GRACE,
        )
        if settings.coordinate:
            _run_jobs(stack, settings, engine, objects, id)
        socket.listen()  # from here on connections are accepted, and answered soon
        host, port = socket.getsockname()[:2]
        data = f" {settings.data}" if settings.alone else ""
        print(f"envmatte serves{data} at {url_of(host, port)}", flush=True)
        Server(config).run(sockets=[socket])


def coordinate(settings: CoordinatorSettings) -> None:
    """Run jobs while no other coordinator does, until interrupted."""
    with _opened(settings, "coordinator") as (stack, engine, objects, id):
        _run_jobs(stack, settings, engine, objects, id)
        print("envmatte coordinates", flush=True)
        while True:
            time.sleep(1)  # unlike signal.pause(), it ends although a signal comes just before it


def _run_jobs(
    stack: ExitStack, settings: CoordinatorSettings, engine: Engine, objects: Objects, id: str | None
) -> None:
    """Run jobs, and call webhooks about them, until the stack is closed."""
    dispatcher = stack.enter_context(dispatcher_of(settings, id))
    coordinator = stack.enter_context(Coordinator(settings, engine, objects, dispatcher))
    if settings.webhook_secret:
        stack.enter_context(Sender(settings, engine, lambda: coordinator.token))


@contextmanager
def _opened(
    settings: CoordinatorSettings, role: str, *, mark: bool = True
) -> Iterator[tuple[ExitStack, Engine, Objects, str | None]]:
    """Configure this process, and open the database and the store, with the installation's id.

    The stack is closed before they are.
    """
    # uvicorn raises the signal that stopped it again when it ends: everything open here must be closed first.
    exit_on_signal()
    limit_arenas()
    configure_logging(settings.log, settings.log_level, role)
    warn_of_unknown()
    configure_dask()
    tracing.start(role)
    make_data(settings.data)
    with ExitStack() as stack:
        if settings.alone:
            stack.enter_context(lock_data(settings.data))
        engine = open_engine(settings.database_url)
        stack.callback(engine.dispose)
        keep_reserve(engine)
        objects = Objects(settings.store_url)
        with _slowness_logged(settings.store_url):
            id = installation.recognise(engine, objects, mark=mark)
        yield stack, engine, objects, id


@contextmanager
def _slowness_logged(store: str) -> Iterator[None]:
    """Log what is waited for if the store does not answer for a while."""
    message = (
        "the store %s has not answered for %g s: waiting for it. The address of a bucket is AWS_ENDPOINT_URL"
    )
    timer = Timer(SILENCE, logger.warning, (message, store, SILENCE))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
