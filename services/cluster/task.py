"""What a dask task runs: a step of a job, known by its ids to the worker's log and to the trace of the request."""

import logging
import re
from functools import lru_cache
from typing import Any
from uuid import uuid4

from services.runtime import tracing
from services.runtime.logs import about
from storage.errors import EnvmatteError
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows import jobs
from workflows.jobs import Steps, Task

logger = logging.getLogger(__name__)

NAMES = {PREPARE: "prepare", FINISH: "finish"}
KEY = re.compile(r"[a-z]+-([0-9a-f]+)-(-?\d+)-[0-9a-f]+")


def key_of(kind: str, job: str, tile: int) -> str:
    """A name for a task, another one each time."""
    return f"{kind}-{job}-{tile}-{uuid4().hex[:8]}"


def read_key(key: str) -> tuple[str, int] | None:
    """The job and the tile of a task by its name; None if it has another kind of name."""
    found = KEY.fullmatch(key)
    return (found[1], int(found[2])) if found else None


def run(steps: Steps, store: str, task: Task, tile: int, trace: str | None) -> tuple[float, Any]:
    """As `workflows.jobs.run`.

    Parameters
    ----------
    store : str
        URL of the object store, which a worker process opens once.
    trace : str, optional
        The ``traceparent`` of the request that asked for the job.
    """
    which = {"tile": tile} if tile >= 0 else {}
    name = f"{steps.kind} {NAMES.get(tile, 'tile')}"
    with about(task.job, tile), tracing.span(name, trace, job=task.job, kind=steps.kind, **which):
        try:
            seconds, result = jobs.run(steps, _objects(store), task, tile)
        except EnvmatteError as error:
            logger.warning("failed: %s", error.detail, exc_info=True)
            # It alone is sent back: an error of a library that it comes of may not survive the way, nor it with that.
            error.__cause__ = error.__context__ = None
            raise
        except Exception:
            logger.exception("failed")
            raise
        logger.debug("done in %.3f s", seconds)
        return seconds, result


@lru_cache(maxsize=1)
def _objects(url: str) -> Objects:
    """The store of this worker process."""
    return Objects(url)
