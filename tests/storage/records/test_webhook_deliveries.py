"""Webhook deliveries: added when a job ends, kept until they are delivered or given up."""

import json
import time

from sqlalchemy import Connection, select, update

from storage.database.tables import deliveries as table
from storage.records import jobs, webhook_deliveries


def ended(connection: Connection, state: str = "succeeded", **problem: str) -> str:
    job = jobs.add(connection, "recover", "cap", {}, "mat", webhook="https://example.com/x")
    jobs.enter_stage(connection, job, "recovering")
    assert connection.execute(select(table).where(table.c.job == job)).all() == []
    jobs.end(connection, job, state, problem or None)
    return job


def bring_forward(connection: Connection) -> None:
    connection.execute(update(table).values(due_at=time.time() - 1))


def test_end_of_job_is_delivered_once(connection: Connection) -> None:
    job = ended(connection, "failed", detail="no light")
    assert not jobs.end(connection, job, "cancelled")
    (row,) = webhook_deliveries.claim(connection, 9)
    body = json.loads(row.body)
    created_at = body.pop("created_at")
    assert (body["id"], body["event"]) == (row.id, "job.failed")
    job_fields = body["job"]
    assert (
        created_at >= job_fields.pop("finished_at") >= job_fields.pop("created_at") > "2020-01-01T00:00:00Z"
    )
    assert job_fields == {
        "id": job,
        "kind": "recover",
        "state": "failed",
        "capture": "cap",
        "matte": "mat",
        "problem": {"detail": "no light"},
    }
    assert (row.url, row.attempts) == ("https://example.com/x", 1)


def test_retried_job_is_delivered_again(connection: Connection) -> None:
    job = ended(connection, "failed", detail="no light")
    jobs.retry(connection, job)
    jobs.end(connection, job, "succeeded")
    events = [json.loads(row.body)["event"] for row in connection.execute(select(table))]
    assert sorted(events) == ["job.failed", "job.succeeded"]


def test_job_without_webhook_has_no_delivery(connection: Connection) -> None:
    jobs.end(connection, jobs.add(connection, "recover", "cap", {}, "mat"), "succeeded")
    assert not webhook_deliveries.any_due(connection)


def test_claimed_delivery_is_due_again_after_process_died(connection: Connection) -> None:
    ended(connection)
    assert webhook_deliveries.any_due(connection)
    webhook_deliveries.claim(connection, 9)
    assert not webhook_deliveries.any_due(connection)
    bring_forward(connection)
    (row,) = webhook_deliveries.claim(connection, 9)
    assert row.attempts == 2


def test_deliveries_with_fewest_attempts_come_first(connection: Connection) -> None:
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


def test_deleted_job_is_still_delivered(connection: Connection) -> None:
    jobs.delete(connection, ended(connection))
    (row,) = webhook_deliveries.claim(connection, 1)
    webhook_deliveries.delete(connection, row.id)
    assert connection.execute(select(table)).all() == []
