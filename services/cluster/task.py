"""The function that a dask task runs: steps of a job, with their ids in the worker's log and in the trace.

It sends each result as an event, which takes the way of the worker's other messages and comes before that of its end:
to fetch a result, the scheduler would open a connection to its worker.
"""

import logging
import re
import socket
import time
from collections.abc import Sequence
from functools import lru_cache
from typing import Any
from uuid import uuid4

from distributed import get_worker

from services.runtime import tracing
from services.runtime.logs import about
from storage.errors import EnvmatteError, InvalidInput, NoRoom, StoreUnavailable, WrongStore
from storage.objects import marker
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows import jobs
from workflows.jobs import Steps, Task

logger = logging.getLogger(__name__)

BLIND = 5.0
"""Seconds that a worker takes for a step if it does not see the installation's store."""
NAMES = {PREPARE: "prepare", FINISH: "finish"}
KEY = re.compile(r"[a-z]+-([0-9a-f]+)-(-?\d+)-[0-9a-f]+")


def key_of(kind: str, job: str, tile: int) -> str:
    """A key for a dask task that begins with a tile, a different one each time."""
    return f"{kind}-{job}-{tile}-{uuid4().hex[:8]}"


def read_key(key: str) -> tuple[str, int] | None:
    """The job and the first tile of a dask task, from its key; None for a key that `key_of` did not make."""
    found = KEY.fullmatch(key)
    return (found[1], int(found[2])) if found else None


def run(
    tiles: Sequence[int],
    steps: Steps,
    store: str,
    task: Task,
    trace: str | None,
    topic: str,
    installation: str | None = None,
) -> None:
    """Run steps of a job in a worker, one after another.

    Parameters
    ----------
    store : str
        URL of the object store, which a worker process opens once.
    trace : str, optional
        The ``traceparent`` of the request that asked for the job.
    topic : str
        Of an event for each step: the ``key`` of the dask task, the ``tile``, and what `workflows.jobs.run` returns,
        ``seconds`` and ``result``.
    installation : str, optional
        What the store is recognised by, see `storage.objects.marker`.
    """
    worker = get_worker()
    for tile in tiles:
        seconds, result = _run(tile, steps, store, task, trace, installation)
        event = {"key": worker.get_current_task(), "tile": tile, "seconds": seconds, "result": result}
        worker.log_event(topic, event)


def _run(
    tile: int, steps: Steps, store: str, task: Task, trace: str | None, installation: str | None = None
) -> tuple[float, Any]:
    attributes = {"tile": tile} if tile >= 0 else {}
    name = f"{steps.kind} {NAMES.get(tile, 'tile')}"
    with about(task.job, tile), tracing.span(name, trace, job=task.job, kind=steps.kind, **attributes):
        try:
            seconds, result = _run_in_store(steps, _objects(store, installation), task, tile)
        except EnvmatteError as error:
            if not isinstance(error, InvalidInput):  # the caller's fault is for the job to tell
                # With a full disk, or without a store, every tile fails, and the text says why.
                expected = isinstance(error, NoRoom | StoreUnavailable)
                logger.warning("failed: %s", error.detail, exc_info=not expected)
            if isinstance(error, WrongStore):
                time.sleep(BLIND)  # otherwise it would fail all tiles before others come to them
            # Sent back without its cause: an error of a library may not be picklable, and would take this one with it.
            error.__cause__ = error.__context__ = None
            raise
        except Exception:
            logger.exception("failed")
            raise
        logger.debug("done in %.3f s", seconds)
        return seconds, result


def _run_in_store(steps: Steps, objects: Objects, task: Task, tile: int) -> tuple[float, Any]:
    """Run a step; what it read or wrote does not count if the store's folder was unmounted meanwhile."""
    marker.require_mounted(objects, _machine())
    try:
        return jobs.run(steps, objects, task, tile)
    finally:
        marker.require_mounted(objects, _machine())


@lru_cache(maxsize=1)
def _objects(url: str, installation: str | None) -> Objects:
    """The object store of this worker process, once it is found to be the installation's."""
    try:
        objects = Objects(url)
    except StoreUnavailable as error:  # its folder can't be made: that of other workers may be there
        raise WrongStore(f"{_machine()}: {error.detail}") from error
    if installation is not None:
        marker.require(objects, installation, _machine())
        objects.installation = installation
    return objects


def _machine() -> str:
    return f"the worker on {socket.gethostname()}"
