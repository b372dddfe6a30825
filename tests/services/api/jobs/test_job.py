"""What the API says about jobs, from the rows of a database."""

import time
from collections.abc import Callable
from typing import Any

from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine, event

from services.api.jobs.job import Job
from storage.database.engine import reading, writing
from storage.database.rows import page
from storage.database.tables import jobs as table
from storage.records import captures, jobs, leases, tiles


def test_retried_job_counts_seconds_from_the_retry_on(engine: Engine) -> None:
    with writing(engine) as c:
        job = jobs.add(c, "ingest", "c", {})
        jobs.enter_stage(c, job, "preparing")
        jobs.end(c, job, "failed", {"status": 500, "detail": "gave up"})
        then = time.time() - 1000
        jobs.change(c, job, created_at=then, started_at=then + 100, finished_at=then + 300)
        failed = Job.read(c, job)
        assert (round(failed.queued_seconds), round(failed.run_seconds)) == (100, 200)
        jobs.retry(c, job)
        queued = Job.read(c, job)
        jobs.enter_stage(c, job, "preparing")
        running = Job.read(c, job)
    assert (queued.started_at, queued.run_seconds) == (None, 0.0)
    assert running.started_at is not None
    assert max(queued.queued_seconds, running.queued_seconds, running.run_seconds) < 60


def test_page_of_jobs_takes_as_many_queries_as_a_job_of_each_kind(engine: Engine) -> None:
    def add(number: int) -> None:
        """Add a recovery that waits for an ingest, one that runs, and an ingest that runs."""
        with writing(engine) as c:
            ingest = jobs.add(c, "ingest", f"new-{number}", {})
            captures.add(c, f"new-{number}", ingest, name="", bytes=1, frames=1, program={})
            jobs.add(c, "recover", f"new-{number}", {}, f"m-{number}")
            for job in (ingest, jobs.add(c, "recover", "ready", {}, f"n-{number}")):
                jobs.enter_stage(c, job, "preparing")
                tiles.add_plan(c, job, {"tiles": 2, "frames": 1, "width": 8, "height": 8})
                tiles.start_pace(c, job, after=0)

    def read() -> tuple[list[Job], int]:
        queries.clear()
        with reading(engine) as c:
            found = list(Job.of(c, page(c, table, 100, None)))
        return found, len(queries)

    queries: list[Any] = []
    with writing(engine) as c:
        captures.add(c, "ready", "", name="", bytes=1, frames=1, program={})
        captures.change(c, "ready", state="ready")
        token = leases.acquire(c, "here")
        assert token is not None
        leases.renew(c, token, {"workers": ["a", "b"], "problem": None})
    event.listen(engine, "before_cursor_execute", lambda *arguments: queries.append(arguments))
    add(0)
    one_each, few = read()
    assert [job.waits_for for job in one_each] == [
        "it shares the workers, 2 in all, with other jobs: 1",
        "its capture new-0 is being ingested",
        "it shares the workers, 2 in all, with other jobs: 1",
    ]
    for number in range(1, 6):
        add(number)
    found, many = read()
    assert (len(found), many) == (18, few)


def test_job_without_progress_says_what_takes_long(engine: Engine) -> None:
    with writing(engine) as c:
        token = leases.acquire(c, "here")
        assert token is not None
        leases.renew(c, token, {"workers": ["a"], "problem": None})
        job = jobs.add(c, "ingest", "c", {})
        jobs.enter_stage(c, job, "preparing")
        tiles.add_plan(c, job, {"tiles": 2, "frames": 1, "width": 8, "height": 8})
        for done, what in ((0, "a tile"), (2, "its last step")):
            tiles.mark_done(c, job, [(tile, 1.0, 1) for tile in range(done)])
            jobs.change(c, job, moved_at=time.time() - 40)
            waits_for = Job.read(c, job).waits_for
            assert (
                waits_for == f"no progress in the last 40 s: {what} takes long, or its worker does not answer"
            )


def test_a_job_that_a_newer_service_queued_is_shown(engine: Engine, build: Callable[..., FastAPI]) -> None:
    with writing(engine) as c:
        job = jobs.add(c, "newer", "c", {})
    client = TestClient(build(), "http://localhost")
    assert [found["kind"] for found in client.get("/v1/jobs").json()["jobs"]] == ["newer"]
    region = {"region": {"x": 0, "y": 0, "width": 1, "height": 1}}
    refused = client.patch(f"/v1/jobs/{job}", json=region)
    assert (refused.status_code, "is no recovery" in refused.json()["detail"]) == (422, True)
