"""The steps of a job in order: prepare, its tiles in any order, finish.

Each step is what a dask task runs. It is told ids and numbers, never arrays; it can be run again, by anyone, at any
time, and writes the same bytes: a worker that was thought dead may wake up and go on.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

from storage.layout import captures, composites, mattes
from storage.layout.captures import Stack
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows.composite.placement import Placement
from workflows.composite.video import steps as video_steps
from workflows.ingest import steps as ingest_steps
from workflows.ingest.report.calibration import measure
from workflows.ingest.report.survey import survey
from workflows.mattes import tiles
from workflows.mattes.options import parse_options
from workflows.untrusted.limits import Limits

GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Task:
    """What the steps of a job need to know: small and plain, for it goes to workers.

    Attributes
    ----------
    job : str
        Id of the job.
    store : str
        URL of the object store.
    capture : str
        Id of the capture; empty for a composite of a matte that has none.
    matte : str
        Id of the matte; empty for ingest.
    options : dict
        Of recovery, or of a composite (``transfer``, ``placement``); empty for ingest.
    limits : Limits
        What a bundle may cost.
    plan : dict
        What `prepare` returned; empty before.
    """

    job: str
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
    missing : callable
        Returns the tiles that are not in the store, once all are done.
    finish : callable
        Ends it; returns figures for the record.
    scattered : bool
        Whether its tiles are taken from all over the frame, so that the first of them tell how long the rest will take,
        and not one after another, which is how a video is read.
    """

    stage: str
    prepare: Callable[[Task], dict[str, Any]]
    work: Callable[[Task, int], int]
    missing: Callable[[Task], list[int]]
    finish: Callable[[Task], dict[str, Any]]
    scattered: bool


def _ingest_prepare(task: Task) -> dict[str, Any]:
    return ingest_steps.prepare(_objects(task.store), task.capture, task.limits)


def _ingest_work(task: Task, tile: int) -> int:
    return ingest_steps.read_slab(_objects(task.store), task.capture, task.limits, task.plan["slab"], tile)


def _ingest_missing(task: Task) -> list[int]:
    return Stack(_objects(task.store), task.capture).missing()


def _ingest_finish(task: Task) -> dict[str, Any]:
    _objects(task.store).sweep(captures.path(task.capture))
    stack = Stack(_objects(task.store), task.capture)
    measure(stack)
    survey(stack)
    stack.save()
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


def _recover_missing(task: Task) -> list[int]:
    matte = mattes.Matte(_objects(task.store), task.matte)
    blocks = matte.missing()
    return [
        tile
        for tile, (rows, columns) in enumerate(
            tiles.cut(matte, parse_options(task.options).tile or matte.block)
        )
        if not blocks.isdisjoint(product(rows, columns))
    ]


def _recover_finish(task: Task) -> dict[str, Any]:
    _objects(task.store).sweep(mattes.path(task.matte))
    return mattes.Matte(_objects(task.store), task.matte).figures


def _composite_prepare(task: Task) -> dict[str, Any]:
    return video_steps.prepare(_objects(task.store), task.job, task.matte, task.limits)


def _composite_work(task: Task, tile: int) -> int:
    transfer, placement = task.options["transfer"], Placement(**task.options["placement"])
    objects = _objects(task.store)
    return video_steps.work(objects, task.job, task.matte, transfer, placement, task.limits, task.plan, tile)


def _composite_missing(task: Task) -> list[int]:
    return composites.missing(_objects(task.store), task.job, task.plan["tiles"])


def _composite_finish(task: Task) -> dict[str, Any]:
    video_steps.finish(_objects(task.store), task.job, task.plan)
    return {}


KINDS = {
    "ingest": Kind("reading", _ingest_prepare, _ingest_work, _ingest_missing, _ingest_finish, False),
    "recover": Kind("recovering", _recover_prepare, _recover_work, _recover_missing, _recover_finish, True),
    "composite": Kind(
        "compositing", _composite_prepare, _composite_work, _composite_missing, _composite_finish, False
    ),
}


def order(kind: str, todo: Sequence[int]) -> list[int]:
    """The order in which the tiles of a job are best done."""
    if not KINDS[kind].scattered:
        return sorted(todo)
    # Multiples of the golden ratio, modulo 1, fall evenly over the unit interval however many there are.
    return sorted(todo, key=lambda tile: tile * GOLDEN % 1)


def run(kind: str, task: Task, tile: int) -> tuple[float, Any]:
    """A step of a job: one of its tiles, or `PREPARE` or `FINISH`.

    Returns
    -------
    float
        Seconds that it took.
    int or dict
        Of a tile, its pixels. Of `PREPARE`, the plan. Of `FINISH`, figures for the record; or, under ``missing``, the
        tiles that are not in the store and must be done again first.
    """
    start = time.perf_counter()
    steps = KINDS[kind]
    result: Any
    if tile == PREPARE:
        result = steps.prepare(task)
    elif tile == FINISH:
        missing = steps.missing(task)
        result = {"missing": missing} if missing else steps.finish(task)
    else:
        result = steps.work(task, tile)
    return time.perf_counter() - start, result


@lru_cache(maxsize=1)
def _objects(url: str) -> Objects:
    """A worker's connection to the store."""
    return Objects(url)
