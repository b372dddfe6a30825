"""Time until a job succeeds, from the rows of a database."""

from typing import Any

import pytest
from sqlalchemy import Connection, Engine, update

from services.api.jobs.eta import STEPS, TRIAL, TYPICAL, seconds_left, seconds_to_recover
from services.api.jobs.situation import Situation
from storage.database import rows, tables
from storage.database.engine import writing
from storage.records import captures, jobs, leases, tiles
from storage.steps import FINISH

PLAN = {"tiles": 10, "slab": 4, "width": 160, "height": 120, "frames": 40, "video": False, "notes": []}
FINISHING = TYPICAL * (40 * 160 * 120 + TRIAL)


def running(connection: Connection, kind: str, done: int, plan: dict[str, Any] = PLAN, **values: Any) -> str:
    """A job with ten tiles of one second each, whose pace is measured from time 0 and tile 0 on."""
    job = jobs.add(connection, kind, "a-capture", {})
    tiles.add_steps(connection, job)
    jobs.enter_stage(connection, job, "reading")
    tiles.add_plan(connection, job, plan)
    tiles.mark_done(connection, job, [(tile, 1.0, 1) for tile in range(done)])
    values = {"paced_at": 0.0, "paced_done": 0, "moved_at": float(done)} | values
    connection.execute(update(tables.jobs).where(tables.jobs.c.id == job).values(values))
    return job


def ended(connection: Connection, finishing: float, plan: dict[str, Any] = PLAN) -> None:
    """Add an ingest that has succeeded, with the duration of its last step."""
    job = running(connection, "ingest", 10, plan)
    about = {"name": "", "bytes": 1, "frames": 40, "program": {}}
    captures.add(connection, rows.new_id(), job, **about)
    tiles.mark_done(connection, job, [(FINISH, finishing, 0)])
    jobs.end(connection, job, "succeeded")


def left(connection: Connection, job: str, now: float) -> float | None:
    return seconds_left(jobs.get(connection, job), now, Situation(connection))


def test_recovery_continues_at_its_pace(engine: Engine) -> None:
    with writing(engine) as c:
        job = running(c, "recover", 2)
        assert left(c, job, 2.0) == pytest.approx(8)
        assert left(c, job, 2.5) == pytest.approx(7.5)
        assert left(c, running(c, "recover", 10), 10.0) is None
        assert left(c, running(c, "recover", 2, paced_at=None), 2.0) is None


def test_workers_that_stop_do_not_use_up_the_time_left(engine: Engine) -> None:
    with writing(engine) as c:
        token = leases.acquire(c, "here")
        assert token is not None
        leases.renew(c, token, {"workers": [{}] * 3, "problem": None})
        job = running(c, "recover", 2)
        assert [left(c, job, now) for now in (4.0, 5.0, 60.0, 3600.0)] == [6.0, 5.0, 5.0, 5.0]
        last = running(c, "recover", 8)
        assert [left(c, last, now) for now in (9.0, 10.0, 60.0)] == [1.0, None, None]


def test_ingest_has_a_step_after_its_tiles(engine: Engine) -> None:
    with writing(engine) as c:
        assert left(c, running(c, "ingest", 2), 2.0) == pytest.approx(8 + FINISHING)
        job = running(c, "ingest", 10, stage="finishing", stage_at=10.0)
        assert left(c, job, 10.1) == pytest.approx(FINISHING - 0.1)
        assert left(c, job, 1000.0) is None
        assert left(c, running(c, "ingest", 10), 11.0) == pytest.approx(FINISHING)


def test_last_step_takes_as_long_as_in_earlier_ingests(engine: Engine) -> None:
    with writing(engine) as c:
        job = running(c, "ingest", 10)
        ended(c, 60.0)  # the first one on a machine compiles kernels, so it must not count much
        assert left(c, job, 11.0) == pytest.approx(FINISHING)
        ended(c, 6.0)
        assert left(c, job, 11.0) == pytest.approx(6.0)
        ended(c, 7.0)
        ended(c, 8.0)
        assert left(c, job, 11.0) == pytest.approx(7.0)
        for _ in range(3):
            ended(c, 20.0, PLAN | {"video": True})
        assert left(c, job, 11.0) == pytest.approx(7.0)


def test_recovery_is_estimated_by_trial_and_workers(engine: Engine) -> None:
    with writing(engine) as c:
        ended(c, 1.0, PLAN | {"core_seconds": {"fine": 120.0, "fast": 60.0}})
        (row,) = c.execute(tables.captures.select()).all()
        assert seconds_to_recover(c, row) is None  # there is no worker
        token = leases.acquire(c, "here")
        assert token is not None
        for workers, shared in ((3, 3), (1000, 20)):  # a frame of 160 x 120 pixels has 20 blocks
            leases.renew(c, token, {"workers": [{}] * workers, "problem": None})
            assert seconds_to_recover(c, row) == {"fine": STEPS + 120 / shared, "fast": STEPS + 60 / shared}
        jobs.delete(c, row.job)
        assert seconds_to_recover(c, row) is None
