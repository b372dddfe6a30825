"""A kind of job that takes time and does nothing: a worker that preloads this module knows it."""

import time

from services.coordinator import job_kinds
from workflows.jobs import KINDS, Kind

KINDS["simulated"] = Kind(
    stage="working",
    prepare=lambda task: {"tiles": task.options["tiles"]},
    work=lambda task, tile: time.sleep(task.options["seconds"]) or 1000,
    missing=lambda task: [],
    finish=lambda task: {},
    scattered=True,
)
job_kinds.KINDS["simulated"] = job_kinds.Kind()
