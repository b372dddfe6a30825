"""What a dask task runs: a step of a job, known by its ids to the worker's log and to the trace of the request."""

import logging
from typing import Any

from services import tracing
from services.process import about
from storage.errors import EnvmatteError
from storage.jobs import FINISH, PREPARE
from workflows import jobs
from workflows.jobs import Task

logger = logging.getLogger(__name__)

NAMES = {PREPARE: "prepare", FINISH: "finish"}


def run(kind: str, task: Task, tile: int, trace: str | None) -> tuple[float, Any]:
    """As `workflows.jobs.run`.

    Parameters
    ----------
    trace : str, optional
        The ``traceparent`` of the request that asked for the job.
    """
    which = {"tile": tile} if tile >= 0 else {}
    name = f"{kind} {NAMES.get(tile, 'tile')}"
    with about(task.job, tile), tracing.span(name, trace, job=task.job, kind=kind, **which):
        try:
            seconds, result = jobs.run(kind, task, tile)
        except EnvmatteError as error:
            logger.warning("failed: %s", error.detail, exc_info=True)
            raise
        except Exception:
            logger.exception("failed")
            raise
        logger.debug("done in %.3f s", seconds)
        return seconds, result
