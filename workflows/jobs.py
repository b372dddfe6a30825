"""The steps of a job: prepare, then its tiles in any order, then finish.

A dask task runs one step. It gets ids and numbers, never arrays. Every step is idempotent and writes the same bytes
each time: a worker that was given up for dead may come back and finish.

Each workflow declares its steps beside them, as ``STEPS``: `workflows.ingest.steps`, `workflows.mattes.steps` and
`workflows.composite.video.steps`.
"""

import time
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows.untrusted.limits import Limits

GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Task:
    """What the steps of a job need to know: small and plain, because it is sent to workers.

    Attributes
    ----------
    job : str
        Id of the job.
    capture : str
        Id of the capture; empty for a composite of a matte without one.
    matte : str
        Id of the matte; empty for an ingest.
    options : dict
        Of a recovery, or of a composite (``transfer``, ``placement``); empty for an ingest.
    limits : Limits
        How much a capture archive, or a clip, may take.
    plan : dict
        What ``prepare`` returned; empty before.
    """

    job: str
    capture: str
    matte: str
    options: dict[str, Any]
    limits: Limits
    plan: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Steps:
    """The steps of one kind of job.

    It is sent to workers: its functions are defined at the top of a module, so that they are pickled by name.

    Attributes
    ----------
    kind : str
        The kind of job: ``recover``, for example.
    stage : str
        The stage of the job while its tiles are worked on.
    prepare : callable
        Returns the plan: ``tiles``, their number, and whatever else the steps and the records need. ``notes``, if
        present, are lines for the job's log.
    work : callable
        Does one tile; returns the number of its pixels.
    missing : callable
        Returns the tiles that are not in the store, after all of them were done.
    finish : callable
        Ends the job; returns figures for its record.
    scattered : bool
        Whether tiles are taken from all over the frame, so that the first ones predict how long the rest take, and not
        in sequence, as a video is read.
    inside : callable, optional
        Returns the tiles that show some of a region of the frame, given the plan, the options, and the region's x, y,
        width and height; None if tiles are no parts of a frame.
    """

    kind: str
    stage: str
    prepare: Callable[[Objects, Task], dict[str, Any]]
    work: Callable[[Objects, Task, int], int]
    missing: Callable[[Objects, Task], list[int]]
    finish: Callable[[Objects, Task], dict[str, Any]]
    scattered: bool
    inside: Callable[[dict[str, Any], dict[str, Any], Sequence[int]], Container[int]] | None = None


def order(steps: Steps, tiles: Iterable[int], first: Container[int] = ()) -> list[int]:
    """The order in which tiles of a job are best done, after those that are wanted first."""
    if not steps.scattered:
        return sorted(tiles)
    # Multiples of the golden ratio, modulo 1, are spread evenly over the unit interval however many there are.
    return sorted(tiles, key=lambda tile: (tile not in first, tile * GOLDEN % 1))


def run(steps: Steps, objects: Objects, task: Task, tile: int) -> tuple[float, Any]:
    """Run one step of a job.

    Parameters
    ----------
    tile : int
        Number of the tile, or `PREPARE`, or `FINISH`.

    Returns
    -------
    float
        Seconds it took.
    int or dict
        Of a tile, its pixels. Of `PREPARE`, the plan. Of `FINISH`, figures for the record; or, under ``missing``, the
        tiles that are not in the store and must be done again first.
    """
    start = time.perf_counter()
    result: Any
    if tile == PREPARE:
        result = steps.prepare(objects, task)
    elif tile == FINISH:
        missing = steps.missing(objects, task)
        result = {"missing": missing} if missing else steps.finish(objects, task)
    else:
        result = steps.work(objects, task, tile)
    return time.perf_counter() - start, result


def run_all(steps: Steps, objects: Objects, task: Task) -> None:
    """Run all steps of a job in this process, one after another."""
    _, plan = run(steps, objects, task, PREPARE)
    task = replace(task, plan=plan)
    for step in (*range(plan["tiles"]), FINISH):
        run(steps, objects, task, step)
