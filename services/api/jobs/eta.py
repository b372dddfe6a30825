"""When a job will have succeeded: by the pace of its tiles, and by how long the step after them took other jobs."""

from statistics import median_low
from typing import Any

from sqlalchemy import Connection, Row

from storage.records import statistics

TYPICAL = 1.4e-7
"""Seconds of a 2.5 GHz core for a unit of `_survey_of`."""


def seconds_left(connection: Connection, row: Row[Any], now: float) -> float | None:
    """Seconds until a running job has succeeded; None until the pace of its tiles is known.

    Parameters
    ----------
    now : float
        Seconds of the epoch.
    """
    if not row.total:
        return None
    finishing = _finishing(connection, row) if row.kind == "ingest" else 0.0
    if row.done == row.total:
        begun = now - row.stage_at if row.stage == "finishing" else 0.0
        return max(finishing - begun, 0.0)
    if row.paced_at is None or row.done <= row.paced_done:
        return None
    pace = (row.moved_at - row.paced_at) / (row.done - row.paced_done)
    return float(max((row.total - row.done) * pace - (now - row.moved_at), 0.0)) + finishing


def _finishing(connection: Connection, row: Row[Any]) -> float:
    """Seconds that an ingest will take after its last tile, to find out how the capture turned out.

    At the speed of those before it, as far as there are any: the middle one, for the first that a machine ever does
    compiles its kernels, and others met a machine that was busy. Videos, stored in 16 bits, go by videos.
    """
    ended = [
        (plan, seconds)
        for plan, seconds in statistics.recent_ingests(connection, limit=8)
        if plan.get("video") == row.plan.get("video")
    ]
    speeds = [TYPICAL, *(seconds / _survey_of(plan) for plan, seconds in ended[:4])]
    return _survey_of(row.plan) * median_low(speeds)


def _survey_of(plan: dict[str, Any]) -> float:
    """Work of `workflows.ingest.report.survey`: pixels of its windows in all frames, and of its trial."""
    return float(plan["frames"] * (min(plan["width"], 384) * min(plan["height"], 384) + 100_000))
