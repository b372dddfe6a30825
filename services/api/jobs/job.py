"""A job as answers have it: its row, and what its situation tells."""

import time
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from itertools import islice
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import Connection, Row

from services.api.http.responses import utc_time
from services.api.jobs.eta import seconds_left
from services.api.jobs.situation import Situation
from services.api.jobs.wait_reason import reason
from storage.records import jobs

ROWS_AT_ONCE = 20


class Region(BaseModel):
    """A rectangle of the frame, in pixels; what reaches beyond the frame does not matter."""

    model_config = ConfigDict(extra="forbid")
    x: int = Field(ge=0, le=1 << 20)
    y: int = Field(ge=0, le=1 << 20)
    width: int = Field(ge=1, le=1 << 20)
    height: int = Field(ge=1, le=1 << 20)

    @classmethod
    def of(cls, stored: list[int] | None) -> "Region | None":
        """A region as it is stored."""
        return (
            None if stored is None else cls.model_validate(dict(zip(cls.model_fields, stored, strict=True)))
        )

    @property
    def stored(self) -> list[int]:
        """As it is stored."""
        return [self.x, self.y, self.width, self.height]


class Tiles(BaseModel):
    """Parts of a job's work: squares of a matte, slabs of frames, or segments of a clip."""

    total: int
    done: int
    failed: int


class Job(BaseModel):
    """A job; `name` is that of its matte, or else of its capture, and empty once they are deleted.

    Of a job that was retried, `started_at`, `queued_seconds` and `run_seconds` are those since then.
    """

    id: str
    kind: str = Field(
        description="`ingest`, `recover` or `composite`; a newer service may have queued others."
    )
    name: str
    state: jobs.State
    stage: str
    progress: float
    tiles: Tiles
    pixels: int
    eta_seconds: float | None
    waits_for: str | None
    queued_seconds: float
    run_seconds: float
    workers: int
    paused: bool
    region: Region | None
    capture: str | None
    matte: str | None
    options: dict[str, Any]
    problem: dict[str, Any] | None
    video: str | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None

    @classmethod
    def read(cls, connection: Connection, id: str) -> "Job":
        """A job by its id; `NotFound` if there is none."""
        return next(cls.of(connection, [jobs.get(connection, id)]))

    @classmethod
    def of(cls, connection: Connection, rows: Iterable[Row[Any]]) -> Iterator["Job"]:
        """Jobs by their rows, of which few are in memory at a time: a plan may be large."""
        situation = Situation(connection)
        rows = iter(rows)
        while some := list(islice(rows, ROWS_AT_ONCE)):
            names = jobs.names(connection, some)
            for row in some:
                yield cls._of(row, names[row.id], situation)

    @classmethod
    def _of(cls, row: Row[Any], name: str, situation: Situation) -> "Job":
        now = time.time()
        # Not below zero: the clock may go back.
        ran = max((row.finished_at or now) - row.started_at, 0.0) if row.started_at else 0.0
        queued_at = row.queued_at or row.created_at
        running = row.state == "running"
        # The step after the last tile counts as one more tile, so only a job that has succeeded is at 1.
        progress = 1.0 if row.state == "succeeded" else row.done / (row.total + 1) if row.total else 0.0
        return cls(
            **{
                name: getattr(row, name)
                for name in ("id", "kind", "state", "stage", "pixels", "matte", "paused")
            },
            name=name,
            region=Region.of(row.region),
            capture=row.capture or None,  # the composite of an imported matte has none
            progress=progress,
            tiles=Tiles(total=row.total, done=row.done, failed=row.failed),
            eta_seconds=seconds_left(row, now, situation) if running else None,
            waits_for=reason(row, situation),
            queued_seconds=max((row.started_at or row.finished_at or now) - queued_at, 0.0),
            run_seconds=ran,
            workers=situation.workers if running else 0,
            options=row.options,
            problem=row.problem,
            video=f"/v1/jobs/{row.id}/video.mp4"
            if row.kind == "composite" and row.state == "succeeded"
            else None,
            created_at=datetime.fromtimestamp(row.created_at, UTC),
            started_at=utc_time(row.started_at),
            finished_at=utc_time(row.finished_at),
        )
