"""What the end of a composite job changes in a real database and a real store."""

import pytest
from sqlalchemy import Engine

from services.coordinator.job_kinds import JOB_KINDS
from services.coordinator.job_run import JobRun, write_failure
from services.coordinator.retention import sweep
from storage.database.engine import writing
from storage.errors import CaptureError, ClipError, Conflict, EnvmatteError, GaveUp, NotFound
from storage.layout import composites
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes, tiles
from workflows.untrusted.limits import Limits

MADE = (composites.clip_path, composites.ticks_path, composites.video_path)


@pytest.fixture
def job(engine: Engine, objects: Objects) -> str:
    """A composite job that has written something."""
    with writing(engine) as c:
        mattes.add(c, "m", "cap", "other", {})
        mattes.change(c, "m", state="ready")
        job = jobs.add(c, "composite", "cap", {"transfer": "srgb"}, "m")
        tiles.add_steps(c, job)
    for path in MADE:
        objects.put(path(job), b"any")
    objects.put(composites.segment_path(job, 0), b"any")
    return job


def fail(engine: Engine, job: str, error: EnvmatteError) -> None:
    with writing(engine) as c:
        run = JobRun.of(jobs.get(c, job), [], Limits(1, 1))
        write_failure(c, run.kind, run.task, error)


@pytest.mark.parametrize(
    ("error", "stored", "state"),
    [(CaptureError("no frames"), 0, None), (GaveUp("again"), None, "ingesting"), (None, 0, None)],
    ids=["useless", "may be retried", "cancelled"],
)
def test_bytes_of_a_capture_count_as_long_as_they_are_kept(
    engine: Engine, error: EnvmatteError | None, stored: int | None, state: str | None
) -> None:
    kind = JOB_KINDS["ingest"]
    with writing(engine) as c:
        job = jobs.add(c, "ingest", "c", {})
        captures.add(c, "c", job, name="", bytes=9, frames=1, program={})
    if error is not None:
        fail(engine, job, error)
    with writing(engine) as c:
        if error is None:
            kind.cancelled(c, jobs.get(c, job))
        row = captures.get(c, "c")
        assert (row.state, row.stored) == ("failed", stored)  # None: they are counted
        captures.change(c, "c", stored=5)
        if state is None:
            with pytest.raises(Conflict, match="upload it again"):
                kind.retried(c, jobs.get(c, job))
        else:
            kind.retried(c, jobs.get(c, job))
            assert (captures.get(c, "c").state, captures.get(c, "c").stored) == (state, None)


def test_recovery_of_a_capture_that_failed_is_not_retried(engine: Engine) -> None:
    with writing(engine) as c:
        job = jobs.add(c, "recover", "c", {}, "m")
        mattes.add(c, "m", "c", job, {})
        mattes.change(c, "m", state="failed", stored=5)
        captures.add(c, "c", "other", name="", bytes=9, frames=1, program={})
        captures.change(c, "c", state="ready")
        JOB_KINDS["recover"].retried(c, jobs.get(c, job))
        assert (mattes.get(c, "m").state, mattes.get(c, "m").stored) == ("recovering", None)
        captures.change(c, "c", state="failed", problem={"detail": "it is damaged", "status": 500})
        with pytest.raises(Conflict, match="capture c failed: it is damaged"):
            JOB_KINDS["recover"].retried(c, jobs.get(c, job))


def test_a_composite_changes_no_matte_and_needs_no_capture(engine: Engine, job: str) -> None:
    with writing(engine) as c:
        assert JOB_KINDS["composite"].is_due(c, jobs.get(c, job))
    fail(engine, job, GaveUp("again and again"))
    with writing(engine) as c:
        assert mattes.get(c, "m").state == "ready"


def test_after_success_only_the_video_is_left(objects: Objects, engine: Engine, job: str) -> None:
    with writing(engine) as c:
        run = JobRun.of(jobs.get(c, job), [], Limits(1, 1))
        jobs.change(c, job, stored=7)  # of the clip
        run.kind.succeeded(c, run.task, {})
        row = jobs.get(c, job)
    assert row.stored is None  # it is counted again
    JOB_KINDS["composite"].remove_inputs(objects, row)
    assert objects.paths_below(composites.path(job)) == {composites.video_path(job)}
    JOB_KINDS["composite"].remove_files(objects, row)
    assert objects.paths_below(composites.path(job)) == set()


@pytest.mark.parametrize(("error", "kept"), [(ClipError("no clip"), False), (GaveUp("again"), True)])
def test_a_clip_is_kept_while_its_job_may_be_retried(
    engine: Engine, objects: Objects, job: str, error: EnvmatteError, kept: bool
) -> None:
    with writing(engine) as c:
        jobs.change(c, job, stored=7)
    fail(engine, job, error)
    with writing(engine) as c:
        assert jobs.get(c, job).stored == (7 if kept else 0)
    sweep(engine, objects, objects.clock() + 1)
    assert bool(objects.paths_below(composites.path(job))) == kept
    with writing(engine) as c:
        row = jobs.get(c, job)
        if kept:
            JOB_KINDS["composite"].retried(c, row)
            mattes.delete(c, "m")
        with pytest.raises(NotFound if kept else Conflict):
            JOB_KINDS["composite"].retried(c, row)


def test_a_sweep_removes_only_what_no_job_refers_to(engine: Engine, objects: Objects, job: str) -> None:
    objects.put(composites.clip_path("unknown"), b"any")
    sweep(engine, objects, objects.clock() + 1)
    assert objects.names("composites") == [job]
    with writing(engine) as c:
        jobs.change(c, job, stored=7)
        jobs.cancel(c, job)
        JOB_KINDS["composite"].cancelled(c, jobs.get(c, job))
        assert jobs.get(c, job).stored == 0
    sweep(engine, objects, objects.clock() + 1)
    assert objects.names("composites") == []
