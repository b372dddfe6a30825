"""What the API says about jobs, from the rows of a database."""

import time

from sqlalchemy import Engine

from services.api.jobs.jobs import Job
from storage.database.engine import writing
from storage.records import jobs


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
