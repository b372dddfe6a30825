"""Time until a job succeeds: by the pace of its tiles and by earlier jobs, or, before it starts, by a trial."""

from statistics import median_low
from typing import Any

from sqlalchemy import Connection, Row, select

from services.api.jobs.situation import Situation
from storage.database.tables import jobs
from storage.layout.blocks import block_edge

TYPICAL = 8e-8
"""Seconds per unit of `_report_work` on a 2.5 GHz core."""
TRIAL = 4e7
"""What the trial recovery of a report takes, in the same units: it tries as many pixels, whatever the frames."""
STEPS = 1.0
"""Seconds that a recovery takes beside those of its pixels: to prepare, and to finish."""


def seconds_left(row: Row[Any], now: float, situation: Situation) -> float | None:
    """Seconds until a running job has succeeded; None until the pace of its tiles is known, or if it is late.

    Parameters
    ----------
    now : float
        Seconds of the epoch.
    """
    if not row.total or row.paused:
        return None
    finishing = _finishing(row, situation) if row.kind == "ingest" else 0.0
    if row.done == row.total:
        left = finishing - (now - row.stage_at if row.stage == "finishing" else 0.0)
        return left if left > 0 else None
    if row.paced_at is None or row.done <= row.paced_done or row.moved_at <= row.paced_at:
        return None  # the last: the clock has gone back
    pace = (row.moved_at - row.paced_at) / (row.done - row.paced_done)
    # No more has been done meanwhile than each worker's tile: workers may have stopped, or the clock gone forward.
    since = min(now - row.moved_at, pace * max(situation.workers, 1))
    left = float((row.total - row.done) * pace - since)
    return left + finishing if left > 0 else None


def seconds_to_recover(connection: Connection, capture: Row[Any]) -> dict[str, float] | None:
    """Seconds that a recovery of a capture will take by quality, by the trial of its ingest and the workers of now."""
    plan = connection.scalar(select(jobs.c.plan).where(jobs.c.id == capture.job)) or {}
    workers = Situation(connection).workers
    if not plan.get("core_seconds") or not workers:
        return None
    edge = block_edge(plan["height"], plan["width"])
    blocks = -(-plan["height"] // edge) * -(-plan["width"] // edge)
    return {name: STEPS + seconds / min(workers, blocks) for name, seconds in plan["core_seconds"].items()}


def _finishing(row: Row[Any], situation: Situation) -> float:
    """Seconds that an ingest will take after its last tile, for the report on the capture.

    It uses the median speed of the last few ingests: the first one on a machine compiles its kernels, and others may
    have run on a busy machine. Videos are stored in 16 bits and are compared only with videos.
    """
    ended = [
        (plan, seconds)
        for plan, seconds in situation.recent_ingests
        if plan.get("video") == row.plan.get("video")
    ]
    speeds = [TYPICAL, *(seconds / _report_work(plan) for plan, seconds in ended[:4])]
    return _report_work(row.plan) * median_low(speeds)


def _report_work(plan: dict[str, Any]) -> float:
    """Pixels that the report works on: the windows of `workflows.ingest.report.survey` in all frames, and its trial."""
    return float(plan["frames"] * min(plan["width"], 384) * min(plan["height"], 384)) + TRIAL
