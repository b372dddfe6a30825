"""The steps of a job in order: prepare, its tiles in any order, finish.

Each step is what a dask task runs. It is told ids and numbers, never arrays; it can be run again, by anyone, and
writes the same bytes.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from storage import captures, mattes
from storage.captures import Stack
from storage.objects import Objects
from workflows import tiles
from workflows.ingest import frames
from workflows.ingest.bundle import Limits
from workflows.ingest.measure import measure
from workflows.ingest.survey import survey
from workflows.options import parse_options


@dataclass(frozen=True)
class Task:
    """What the steps of a job need to know: small and plain, for it goes to workers.

    Attributes
    ----------
    store : str
        URL of the object store.
    capture : str
        Id of the capture.
    matte : str
        Id of the matte; empty for ingest.
    options : dict
        Of recovery; empty for ingest.
    limits : Limits
        What a bundle may cost.
    plan : dict
        What `prepare` returned; empty before.
    """

    store: str
    capture: str
    matte: str
    options: dict[str, Any]
    limits: Limits
    plan: dict[str, Any]


@dataclass(frozen=True)
class Kind:
    """A kind of job.

    Attributes
    ----------
    stage : str
        What is going on while its tiles are worked on.
    prepare : callable
        Returns the plan: ``tiles``, how many there are, and what else the steps and the records need; ``notes``, if it
        has any, are lines for the job's log.
    work : callable
        Does a tile; returns its pixels.
    finish : callable
        Ends it; returns figures for the record.
    """

    stage: str
    prepare: Callable[[Task], dict[str, Any]]
    work: Callable[[Task, int], int]
    finish: Callable[[Task], dict[str, Any]]


def _ingest_prepare(task: Task) -> dict[str, Any]:
    return frames.prepare(_objects(task.store), task.capture, task.limits)


def _ingest_work(task: Task, tile: int) -> int:
    return frames.read_slab(_objects(task.store), task.capture, task.limits, task.plan["slab"], tile)


def _ingest_finish(task: Task) -> dict[str, Any]:
    _objects(task.store).sweep(captures.path(task.capture))
    measure(_objects(task.store), task.capture)
    survey(_objects(task.store), task.capture)
    return {}


def _recover_prepare(task: Task) -> dict[str, int]:
    objects = _objects(task.store)
    stack = Stack(objects, task.capture)
    program, _ = tiles.program_of(task.store, task.capture)
    options = parse_options(task.options)
    columns, rows = tiles.grid_of(task.store, task.capture, options)
    matte = mattes.create(
        objects,
        task.matte,
        height=stack.height,
        width=stack.width,
        columns=columns,
        rows=rows,
        monitor=[program.monitor.width, program.monitor.height],
        crosstalk=stack.attributes["crosstalk"],
        # The tile is left out: the same matte comes out whatever it was.
        options=options.model_dump(mode="json", exclude={"tile"}),
    )
    return {"tiles": len(tiles.cut(matte, options.tile or matte.block))}


def _recover_work(task: Task, tile: int) -> int:
    options = parse_options(task.options)
    return tiles.recover_tile(_objects(task.store), task.capture, task.matte, options, tile)


def _recover_finish(task: Task) -> dict[str, Any]:
    _objects(task.store).sweep(mattes.path(task.matte))
    matte = mattes.Matte(_objects(task.store), task.matte)
    matte.check()
    return {
        name: matte.attributes[name] for name in ("width", "height", "monitor", "columns", "rows", "block")
    }


KINDS = {
    "ingest": Kind("reading", _ingest_prepare, _ingest_work, _ingest_finish),
    "recover": Kind("recovering", _recover_prepare, _recover_work, _recover_finish),
}


def run_prepare(kind: str, task: Task) -> dict[str, Any]:
    """The first step of a job; returns its plan."""
    return KINDS[kind].prepare(task)


def run_tile(kind: str, task: Task, tile: int) -> tuple[float, int]:
    """One tile of a job; returns the seconds it took and its pixels."""
    start = time.perf_counter()
    pixels = KINDS[kind].work(task, tile)
    return time.perf_counter() - start, pixels


def run_finish(kind: str, task: Task) -> dict[str, Any]:
    """The last step of a job; returns figures for the record."""
    return KINDS[kind].finish(task)


@lru_cache(maxsize=1)
def _objects(url: str) -> Objects:
    """A worker's connection to the store."""
    return Objects(url)
