"""A kind of job that only takes time."""

import time
from typing import Any

from services.coordinator.job_kinds import JOB_KINDS, JobKind
from storage.objects.store import Objects
from workflows.jobs import Steps, Task


def prepare(objects: Objects, task: Task) -> dict[str, Any]:
    return {"tiles": task.options["tiles"]}


def work(objects: Objects, task: Task, tile: int) -> int:
    time.sleep(task.options["seconds"])
    return 1000


def missing(objects: Objects, task: Task) -> list[int]:
    return []


def finish(objects: Objects, task: Task) -> dict[str, Any]:
    return {}


class Simulated(JobKind):
    steps = Steps("simulated", "working", prepare, work, missing, finish, scattered=True)


def register() -> None:
    """Register the kind with the coordinator of this process."""
    JOB_KINDS["simulated"] = Simulated()
