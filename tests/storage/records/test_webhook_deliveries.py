"""What is to be told to webhooks: made with a job's end, and there until it is delivered or given up."""

import json
import time

import pytest
from sqlalchemy import Connection, Engine, select, update

from storage.database.engine import writing
from storage.database.tables import deliveries as table
from storage.records import jobs, webhook_deliveries


@pytest.fixture
def connection(engine: Engine):  # type: ignore[no-untyped-def]
    with writing(engine) as connection:
        yield connection


def ended(connection: Connection, state: str = "succeeded", **problem: str) -> str:
    job = jobs.add(connection, "recover", "cap", {}, "mat", webhook="https://example.com/x")
    jobs.enter_stage(connection, job, "recovering")
    assert connection.execute(select(table).where(table.c.job == job)).all() == []
    jobs.end(connection, job, state, problem or None)
    return job


def bring_forward(connection: Connection) -> None:
    connection.execute(update(table).values(due_at=time.time() - 1))


def test_a_jobs_end_is_to_be_told_once(connection: Connection) -> None:
    job = ended(connection, "failed", detail="no light")
    assert not jobs.end(connection, job, "cancelled")
    (row,) = webhook_deliveries.claim(connection, 9)
    body = json.loads(row.body)
    created_at = body.pop("created_at")
    assert (body["id"], body["event"]) == (row.id, "job.failed")
    told = body["job"]
    assert created_at >= told.pop("finished_at") >= told.pop("created_at") > "2020-01-01T00:00:00Z"
    assert told == {
        "id": job,
        "kind": "recover",
        "state": "failed",
        "capture": "cap",
        "matte": "mat",
        "problem": {"detail": "no light"},
    }
    assert (row.url, row.attempts) == ("https://example.com/x", 1)


def test_a_job_that_is_tried_again_is_told_again(connection: Connection) -> None:
    job = ended(connection, "failed", detail="no light")
    jobs.retry(connection, job)
    jobs.end(connection, job, "succeeded")
    events = [json.loads(row.body)["event"] for row in connection.execute(select(table))]
    assert sorted(events) == ["job.failed", "job.succeeded"]


def test_a_job_without_a_webhook_is_not_told(connection: Connection) -> None:
    jobs.end(connection, jobs.add(connection, "recover", "cap", {}, "mat"), "succeeded")
    assert not webhook_deliveries.any_due(connection)


def test_what_is_claimed_is_due_again_when_its_process_was_lost(connection: Connection) -> None:
    ended(connection)
    assert webhook_deliveries.any_due(connection)
    webhook_deliveries.claim(connection, 9)
    assert not webhook_deliveries.any_due(connection)
    bring_forward(connection)
    (row,) = webhook_deliveries.claim(connection, 9)
    assert row.attempts == 2


def test_the_least_tried_come_first(connection: Connection) -> None:
    first = ended(connection)
    webhook_deliveries.claim(connection, 9)
    second = ended(connection)
    bring_forward(connection)
    assert [webhook_deliveries.claim(connection, 1)[0].job for _ in range(2)] == [second, first]
    assert webhook_deliveries.claim(connection, 1) == []


def test_attempts_are_spread_over_a_day_and_end(connection: Connection) -> None:
    ended(connection)
    delays: list[float | None] = []
    while not delays or delays[-1] is not None:
        bring_forward(connection)
        (row,) = webhook_deliveries.claim(connection, 1)
        delays.append(webhook_deliveries.schedule_retry(connection, row.id, row.attempts))
    assert delays == [*webhook_deliveries.DELAYS, None]
    assert delays[:-1] == sorted(set(webhook_deliveries.DELAYS))
    assert sum(webhook_deliveries.DELAYS) <= 86_400
    assert connection.execute(select(table)).all() == []


def test_a_job_that_is_deleted_is_told_nevertheless(connection: Connection) -> None:
    jobs.delete(connection, ended(connection))
    (row,) = webhook_deliveries.claim(connection, 1)
    webhook_deliveries.delete(connection, row.id)
    assert connection.execute(select(table)).all() == []
