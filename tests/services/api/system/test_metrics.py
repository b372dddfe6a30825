"""Metrics and the state of the cluster, from the rows of a database, with few short queries."""

import time
from collections.abc import Callable, Iterator

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import Engine, delete, event, update

from storage.database import tables
from storage.database.engine import writing
from storage.records import captures, jobs, leases
from storage.records import tiles as tile_records

PROGRAM = {"parts": []}


@pytest.fixture
def client(build: Callable[..., FastAPI]) -> Iterator[TestClient]:
    with TestClient(build(), "http://localhost") as opened:
        yield opened


@pytest.fixture
def job(engine: Engine) -> str:
    """A recovery with 10 tiles: five done, of which two are missing from the store, and one failed."""
    with writing(engine) as c:
        ingest = jobs.add(c, "ingest", "a-capture", {})
        captures.add(c, "a-capture", ingest, name="", bytes=123, frames=4, program=PROGRAM)
        jobs.add(c, "recover", "a-capture", {})
        job = jobs.add(c, "recover", "a-capture", {})
        tile_records.add_steps(c, job)
        jobs.enter_stage(c, job, "preparing")
        tile_records.add_plan(c, job, {"tiles": 10})
        jobs.enter_stage(c, job, "recovering")
        tile_records.mark_done(c, job, [(tile, 0.5, 100) for tile in range(5)])
        tile_records.requeue_missing(c, job, [1, 2], 8)
        tile_records.record_failure(c, job, 7, "it is broken", 1)
    return job


def metrics(client: TestClient) -> dict[tuple[str, ...], float]:
    return {
        (sample.name, *(sample.labels[name] for name in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(client.get("/metrics").text)
        for sample in family.samples
    }


def test_series_are_there_before_the_first_event(client: TestClient, engine: Engine, job: str) -> None:
    with writing(engine) as c:
        for table in (tables.captures, tables.jobs, tables.totals):
            c.execute(delete(table))
    found = metrics(client)
    assert {value for (name, *labels), value in found.items() if labels} == {0}
    assert found.keys() >= {
        ("envmatte_captures", "failed"),
        ("envmatte_capture_bytes", "ready"),
        ("envmatte_mattes", "ready"),
        ("envmatte_tile_failures_total", "composite"),
        ("envmatte_tile_seconds_count", "recover"),
    }


def test_tiles_are_counted_by_state(client: TestClient, job: str) -> None:
    found = metrics(client)
    tiles = {s: found["envmatte_tiles", "recover", s] for s in ("queued", "done", "failed", "missing")}
    assert tiles == {"queued": 4, "done": 3, "failed": 1, "missing": 2}
    assert found["envmatte_tile_seconds_count", "recover"] == 5
    assert found["envmatte_tile_seconds_sum", "recover"] == pytest.approx(2.5)
    assert found["envmatte_pixels_total", "recover"] == 500
    assert found["envmatte_tile_failures_total", "recover"] == 1
    assert found["envmatte_tile_losses_total", "recover"] == 2
    assert found["envmatte_jobs", "recover", "queued"] == 1
    assert found["envmatte_capture_bytes", "ingesting"] == 123


def test_work_of_kinds_that_only_a_newer_service_knows_is_counted(
    client: TestClient, engine: Engine, job: str
) -> None:
    with writing(engine) as c:
        c.execute(update(tables.totals).where(tables.totals.c.kind == "recover").values(kind="polish"))
    assert metrics(client)["envmatte_pixels_total", "polish"] == 500


def test_trouble_is_reported_without_a_coordinator(client: TestClient, engine: Engine) -> None:
    assert metrics(client)[("envmatte_trouble",)] == 1
    assert ("envmatte_coordinator_last_sign_seconds",) not in metrics(client)
    assert "no coordinator" in client.get("/v1/cluster").json()["problem"]
    with writing(engine) as c:
        token = leases.acquire(c, "a-host:1")
        assert token is not None
    assert metrics(client)[("envmatte_trouble",)] == 0
    found = client.get("/v1/cluster").json()
    assert (found["coordinator"]["holder"], found["problem"]) == ("a-host:1", None)
    with writing(engine) as c:
        leases.renew(c, token, {"workers": [], "problem": "no worker is connected"})
    assert metrics(client)[("envmatte_trouble",)] == 1
    assert client.get("/v1/cluster").json()["problem"] == "no worker is connected"


def test_memory_limit_is_null_if_one_worker_has_none(client: TestClient, engine: Engine) -> None:
    worker = {"address": "tls://a:1", "name": "a", "threads": 1, "memory_bytes": 5, "memory_limit_bytes": 7}
    with writing(engine) as c:
        token = leases.acquire(c, "a-host:1")
        assert token is not None
        leases.renew(c, token, {"workers": [worker, worker | {"memory_limit_bytes": None}], "problem": None})
    found = client.get("/v1/cluster").json()
    assert (found["memory_bytes"], found["memory_limit_bytes"], found["threads"]) == (10, None, 2)
    assert metrics(client)[("envmatte_workers_memory_bytes",)] == 10


def test_queue_counts_tiles_and_measures_their_pace(client: TestClient, engine: Engine, job: str) -> None:
    queue = client.get("/v1/cluster").json()["queue"]
    assert (queue["jobs_queued"], queue["jobs_running"], queue["tiles_to_do"]) == (2, 1, 6)
    assert queue["tiles_per_second"] is None
    with writing(engine) as c:
        values = {"paced_at": time.time() - 10, "paced_done": 1, "moved_at": time.time() - 2}
        c.execute(update(tables.jobs).where(tables.jobs.c.id == job).values(values))
    assert client.get("/v1/cluster").json()["queue"]["tiles_per_second"] == pytest.approx(0.5, rel=0.05)
    with writing(engine) as c:  # its last step does no tiles
        c.execute(update(tables.jobs).where(tables.jobs.c.id == job).values(done=tables.jobs.c.total))
    assert client.get("/v1/cluster").json()["queue"]["tiles_per_second"] is None


def test_few_queries_and_none_scans_all_tiles(client: TestClient, engine: Engine, job: str) -> None:
    """The number of queries does not depend on the number of jobs, and tiles are read through an index."""
    executed: list[tuple[str, object]] = []
    event.listen(engine, "before_cursor_execute", lambda *a: executed.append((a[2], a[3])))
    client.get("/metrics")
    queries = [(query, given) for query, given in executed if query.startswith("SELECT")]
    assert len(queries) <= 8
    with engine.connect() as c:
        for query, given in queries:
            plan = c.exec_driver_sql(f"EXPLAIN QUERY PLAN {query}", given).all()  # type: ignore[arg-type]
            assert not any(row.detail.startswith("SCAN tiles") for row in plan), (query, plan)
