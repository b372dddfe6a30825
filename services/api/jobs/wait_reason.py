"""Why a job waits, in words, so that no job waits without a reason."""

import time
from typing import Any

from sqlalchemy import Row

from services.api.jobs.situation import Situation
from storage.records import jobs
from storage.records.leases import Heartbeat

SILENCE = 15.0
"""Seconds without a sign of life after which a coordinator counts as gone."""
NO_PROGRESS = 30.0
"""Seconds without progress after which a job says so."""


def trouble_of(heartbeat: Heartbeat | None) -> str | None:
    """What is wrong with the coordinator or its cluster; None if nothing is."""
    if heartbeat is None:
        return (
            "no coordinator has ever given a sign of life; start `envmatte serve` or `envmatte coordinator`"
        )
    if heartbeat.seconds > SILENCE or heartbeat.holder is None:
        return (
            f"no coordinator has given a sign of life for {heartbeat.seconds:.0f} s; start `envmatte serve` or "
            "`envmatte coordinator`, or check that it can reach the database"
        )
    return heartbeat.cluster["problem"]


def reason(row: Row[Any], situation: Situation) -> str | None:
    """Why an active job waits; None if it does not wait, or has ended."""
    if row.state not in jobs.ACTIVE:
        return None
    if row.paused:
        return "it is paused, and does what is left once it is continued"
    heartbeat = situation.heartbeat
    trouble = trouble_of(heartbeat)
    if trouble is not None:
        return trouble
    if heartbeat is not None and row.id in heartbeat.cluster.get("without_store", ()):
        return "its tiles cannot reach the store"
    if row.state == "queued":
        if row.kind == "recover" and row.capture in situation.ingesting:
            return f"its capture {row.capture} is being ingested"
        return "the coordinator starts it soon"
    still = time.time() - row.moved_at
    if still > NO_PROGRESS:
        if row.total and row.done == row.total:
            return f"no progress in the last {still:.0f} s: its last step takes long, or its worker does not answer"
        return f"no progress in the last {still:.0f} s: a tile takes long, or its worker does not answer"
    if others := situation.running - 1:
        return f"it shares the workers, {situation.workers} in all, with other jobs: {others}"
    return None
