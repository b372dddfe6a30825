"""Jobs that end before they start, files that are still written when they are removed, and the cost of progress."""

import re
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, Engine, Row

from services.api.jobs.situation import Situation
from services.api.jobs.wait_reason import reason
from services.cluster.dispatcher import Outcome
from services.coordinator import coordinator, job_run
from services.coordinator.coordinator import POLL, WRITE, Coordinator
from services.coordinator.job_kinds import JOB_KINDS
from services.coordinator.job_run import JobRun, Next
from services.settings import CoordinatorSettings
from storage.database.engine import reading, writing
from storage.errors import CaptureError, NotFound, StoreUnavailable, Unavailable
from storage.layout import uploads
from storage.objects.store import Objects
from storage.records import captures, jobs, leases, mattes, tiles
from storage.steps import PREPARE
from tests.benchmarks.cluster.overhead import measure
from tests.parts.waiting import until
from tests.services.coordinator.dispatchers import Failing, Idle, Refusing, Working

Coordinate = Callable[[Any], Coordinator]
OTHERS = 15
"""Writes once per job, or every few seconds in any case: start, stages, lease."""


@pytest.fixture
def coordinate(engine: Engine, objects: Objects, tmp_path: Path) -> Coordinate:
    """Makes a coordinator that gives tasks to a dispatcher."""
    return lambda dispatcher: Coordinator(CoordinatorSettings(data=tmp_path), engine, objects, dispatcher)


@pytest.fixture
def job(engine: Engine, objects: Objects) -> str:
    """A queued ingest of the capture ``c``."""
    with writing(engine) as c:
        job = jobs.add(c, "ingest", "c", {})
        captures.add(c, "c", job, name="", bytes=3, frames=1, program={})
    objects.put(uploads.part_path("c", "all"), b"zip")
    return job


def test_job_cancelled_while_it_is_started_is_not_run(
    engine: Engine, objects: Objects, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancelled_meanwhile(connection: Connection, row: Row[Any]) -> bool:
        with writing(engine) as c:
            jobs.cancel(c, row.id)
        return True

    monkeypatch.setattr(JOB_KINDS["ingest"], "is_due", cancelled_meanwhile)
    dispatcher = Idle()
    with coordinate(dispatcher):
        until(lambda: not objects.paths_below("uploads"))
    assert dispatcher.submitted == []
    with reading(engine) as c:
        assert (jobs.get(c, job).state, jobs.get(c, job).started_at) == ("cancelled", None)


def test_job_cancelled_after_it_was_read_is_cleaned_up_as_such(
    engine: Engine, objects: Objects, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = jobs.to_run

    def cancelled_after(connection: Connection) -> Sequence[Row[Any]]:
        rows = read(connection)
        with writing(engine) as c:
            if jobs.get(c, job).state == "queued":
                jobs.cancel(c, job)
        return rows

    def without_its_capture(connection: Connection, row: Row[Any]) -> bool:
        raise NotFound("its capture is deleted")

    monkeypatch.setattr(jobs, "to_run", cancelled_after)
    monkeypatch.setattr(JOB_KINDS["ingest"], "is_due", without_its_capture)
    ended: list[str] = []
    monkeypatch.setattr(JOB_KINDS["ingest"], "cancelled", lambda c, row: ended.append(row.id))
    with coordinate(Idle()):
        until(lambda: not objects.paths_below("uploads"))
    assert ended == [job]


def test_paused_job_is_not_run_until_it_is_continued(
    engine: Engine, job: str, coordinate: Coordinate
) -> None:
    with writing(engine) as c:
        jobs.pause(c, job, True)
    dispatcher = Idle()
    with coordinate(dispatcher):
        time.sleep(3 * POLL)
        assert dispatcher.submitted == []
        with writing(engine) as c:
            jobs.pause(c, job, False)
        until(lambda: dispatcher.submitted)
        with writing(engine) as c:
            jobs.pause(c, job, True)  # what is submitted stays
        time.sleep(3 * POLL)
    assert dispatcher.submitted == [(job, PREPARE)]


def test_superseded_coordinator_drops_its_jobs_and_writes_nothing(
    engine: Engine, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coordinator, "BEAT", 3600.0)  # as if it were frozen between two heartbeats
    monkeypatch.setattr(leases, "SECONDS", 3600.0)
    with writing(engine) as c:
        leases.acquire(c, "one that was killed")  # no other runs on the same folder: it need not wait
    dispatcher = Idle()
    with coordinate(dispatcher) as one:
        until(lambda: dispatcher.submitted)
        with writing(engine) as c:
            other = leases.acquire(c, "another", seize=True)
        dispatcher.outcomes = [Outcome(job, PREPARE, done=(1.0, {"tiles": 3}))]
        until(lambda: one.token is None)
        until(lambda: dispatcher.dropped)
        with writing(engine) as c:
            assert jobs.get(c, job).plan is None
            assert other is not None
            leases.release(c, other)
        dispatcher.submitted.clear()
        monkeypatch.setattr(coordinator, "BEAT", 0.1)
        until(lambda: dispatcher.submitted)
    assert dispatcher.dropped == [job]
    with reading(engine) as c:
        last = leases.last_heartbeat(c)
    assert last
    assert last.holder is None  # so that the next one need not wait


def recovery(engine: Engine, matte: str, count: int) -> str:
    """A queued recovery that has its tiles."""
    with writing(engine) as c:
        job = jobs.add(c, "recover", "ready", {}, matte)
        mattes.add(c, matte, "ready", job, {})
        tiles.add_plan(c, job, {"tiles": count})
    return job


@pytest.fixture
def ready(engine: Engine) -> None:
    """The capture ``ready``, which is."""
    with writing(engine) as c:
        captures.add(c, "ready", "", name="", bytes=3, frames=1, program={})
        captures.change(c, "ready", state="ready")


def test_tiles_that_could_not_be_submitted_are_submitted_again(
    engine: Engine, ready: None, coordinate: Coordinate
) -> None:
    job = recovery(engine, "m", 3)
    dispatcher = Refusing()
    with coordinate(dispatcher):
        until(lambda: len(dispatcher.submitted) == 3)
    assert dispatcher.submitted == [(job, tile) for tile in dispatcher.refused]


def test_jobs_share_the_workers_from_the_start_of_the_later_one(
    engine: Engine, ready: None, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coordinator, "POLL", 0.02)
    large = recovery(engine, "large", 1000)
    dispatcher = Working()
    with coordinate(dispatcher):
        until(lambda: len(dispatcher.done) >= 10)
        small = recovery(engine, "small", 9)
        until(lambda: dispatcher.done.count(small) >= 9)
    begin = dispatcher.done.index(small)
    together = dispatcher.done[begin : begin + 16]
    assert 7 <= together.count(large) <= 9


@pytest.mark.parametrize(
    ("trouble", "problem"),
    [
        ("kind", "does not know jobs of the kind 'newer': .* Upgrade it, and retry"),
        ("plan", "the coordinator failed 3 times on this job"),
        ("region", "the coordinator failed 3 times on this job"),
        ("leftovers", None),
    ],
)
def test_job_that_cannot_be_run_holds_up_no_other(
    engine: Engine,
    objects: Objects,
    job: str,
    coordinate: Coordinate,
    monkeypatch: pytest.MonkeyPatch,
    trouble: str,
    problem: str | None,
) -> None:
    def confused(connection: Connection, row: Row[Any]) -> None:
        raise KeyError(row.id)

    whole = [0, 0, 9, 9]
    with writing(engine) as c:
        captures.add(c, "ready", "", name="", bytes=3, frames=1, program={})
        captures.change(c, "ready", state="ready")
        region = whole if trouble == "plan" else None
        bad = jobs.add(c, "newer" if trouble == "kind" else "recover", "ready", {}, "m", region=region)
        tiles.add_plan(c, bad, {"tiles": 3, "figures": {}})
        mattes.add(c, "m", "ready", bad, {})
        if trouble == "leftovers":
            monkeypatch.setattr(JOB_KINDS["recover"], "cancelled", confused)
            jobs.cancel(c, bad)
        newer = jobs.add(c, "newer", "ready", {})
        jobs.cancel(c, newer)
    dispatcher = Idle()
    with coordinate(dispatcher):
        if trouble == "region":
            until(lambda: (bad, 0) in dispatcher.submitted)
            with writing(engine) as c:
                jobs.change(c, bad, region=whole)
        until(lambda: (job, PREPARE) in dispatcher.submitted, 10)
        with writing(engine) as c:
            jobs.cancel(c, job)
        until(lambda: not objects.paths_below("uploads"), 10)
    with reading(engine) as c:
        row = jobs.get(c, bad)
        assert jobs.get(c, newer).leftovers  # for a newer coordinator
    if problem is None:
        assert (row.state, row.leftovers) == ("cancelled", False)
    else:
        assert row.state == "failed"
        assert re.search(problem, row.problem["detail"])
        assert jobs.is_retryable(row.problem)


@pytest.mark.parametrize("error", [Unavailable("the database is busy"), KeyError("odd")])
def test_what_cannot_expire_neither_costs_the_lease_nor_holds_up_jobs(
    engine: Engine, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def failing(connection: Connection) -> list[str]:
        raise error

    monkeypatch.setattr(coordinator, "delete_expired", failing)
    monkeypatch.setattr(coordinator, "BEAT", 0.1)
    dispatcher = Idle()
    with coordinate(dispatcher):
        until(lambda: dispatcher.submitted, 30)
        time.sleep(1.5)
        until(lambda: since_heartbeat(engine) < 1.4)


def since_heartbeat(engine: Engine) -> float:
    with reading(engine) as c:
        last = leases.last_heartbeat(c)
    assert last
    return last.seconds


def test_troubles_before_a_retry_do_not_count(
    engine: Engine, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    troubles = 3

    def confused(connection: Connection, row: Row[Any]) -> bool:
        nonlocal troubles
        if troubles:
            troubles -= 1
            raise KeyError("http://secret")
        return True

    monkeypatch.setattr(JOB_KINDS["ingest"], "is_due", confused)
    dispatcher = Idle()
    with coordinate(dispatcher):

        def row() -> Row[Any]:
            with reading(engine) as c:
                return jobs.get(c, job)

        until(lambda: row().state == "failed")
        assert "3 times on this job, last with: unexpected KeyError" in row().problem["detail"]
        troubles = 2
        with writing(engine) as c:
            jobs.retry(c, job)
        until(lambda: row().state != "queued")
    assert dispatcher.submitted == [(job, PREPARE)]


def test_recovery_takes_no_transaction_while_its_capture_is_ingested(
    engine: Engine, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    is_due = JOB_KINDS["recover"].is_due

    def observed(connection: Connection, row: Row[Any]) -> bool:
        looked.append(row.id)
        return is_due(connection, row)

    monkeypatch.setattr(JOB_KINDS["recover"], "is_due", observed)
    with writing(engine) as c:
        recovery = jobs.add(c, "recover", "c", {}, "m")
        mattes.add(c, "m", "c", recovery, {})
    dispatcher = Idle()
    with coordinate(dispatcher):
        until(lambda: dispatcher.submitted)
        time.sleep(3 * POLL)
        assert looked == []
        with writing(engine) as c:
            captures.change(c, "c", state="ready")
        until(lambda: (recovery, PREPARE) in dispatcher.submitted)
    assert looked == [recovery]


@pytest.mark.parametrize("what", ["start", "clean-up"])
def test_lease_is_renewed_while_many_jobs_are_started_or_cleaned_up(
    engine: Engine, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    seen: list[str] = []
    renew = leases.renew

    def renewed(*arguments: Any) -> None:
        seen.append("renewed")
        renew(*arguments)

    def observed(connection: Connection, row: Row[Any]) -> bool:
        seen.append(row.id)
        return True

    monkeypatch.setattr(leases, "renew", renewed)
    monkeypatch.setattr(JOB_KINDS["composite"], "is_due" if what == "start" else "cancelled", observed)
    monkeypatch.setattr(coordinator, "BEAT", 0.0)
    monkeypatch.setattr(coordinator, "BATCH", 0.0)
    with writing(engine) as c:
        many = [jobs.add(c, "composite", "", {}, "m") for _ in range(5)]
        if what == "clean-up":
            for job in many:
                jobs.cancel(c, job)
    with coordinate(Idle()):
        until(lambda: set(many) <= set(seen))
    assert [one for one in seen if one != "renewed"] == many
    assert all("renewed" in seen[seen.index(a) : seen.index(b)] for a, b in pairwise(many))


def test_job_without_the_store_is_tried_again_and_says_so(
    engine: Engine, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_run, "HOLD", 0.5)
    monkeypatch.setattr(coordinator, "BEAT", 0.1)
    dispatcher, begin = Failing(StoreUnavailable("it is away")), time.monotonic()
    with coordinate(dispatcher):
        until(lambda: len(dispatcher.tried) == 4)
        assert time.monotonic() - begin > 3 * job_run.HOLD
        time.sleep(3 * coordinator.BEAT)
        with reading(engine) as c:
            waits_for = reason(jobs.get(c, job), Situation(c))
    assert waits_for is not None
    assert "cannot reach the store" in waits_for


def test_files_that_cannot_be_removed_are_removed_later(
    engine: Engine, objects: Objects, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = [OSError("Directory not empty"), Unavailable("the store does not answer")]
    remove = JOB_KINDS["ingest"].remove_files

    def failing(objects: Objects, row: Row[Any]) -> None:
        if failures:
            raise failures.pop()
        remove(objects, row)

    monkeypatch.setattr(JOB_KINDS["ingest"], "remove_files", failing)
    monkeypatch.setattr(coordinator, "AGAIN", 0.1)
    with writing(engine) as c:
        jobs.cancel(c, job)
    with coordinate(Idle()):
        until(lambda: not failures)  # a sweep may have removed them before
        until(lambda: not objects.paths_below("uploads"))


def test_files_of_a_failed_job_are_removed_if_it_is_deleted_at_once(
    engine: Engine, objects: Objects, job: str, coordinate: Coordinate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def deleted_meanwhile(run: JobRun, following: Next) -> None:
        with writing(engine) as c:
            jobs.delete(c, run.job)

    monkeypatch.setattr(JobRun, "advance", deleted_meanwhile)
    monkeypatch.setattr(coordinator, "DYING", 0.1)
    dispatcher = Failing(CaptureError("no frames"))
    with coordinate(dispatcher):
        until(lambda: not objects.paths_below("uploads"), 10)
    assert dispatcher.tried == [(job, PREPARE)]


@pytest.mark.exhaustive
def test_progress_takes_a_few_writes_a_second() -> None:
    row = measure(tiles=1500, seconds=0.0, workers=4)
    writes = row["writes a second"] * row["seconds"]
    assert 2 < writes <= row["seconds"] * (1 / WRITE + 0.5) + OTHERS
    assert row["tiles"] > 5 * writes
