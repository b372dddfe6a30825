"""How long calls take in a service that has seen a million jobs.

    python -m tests.benchmarks.service.many_rows [--jobs 1000000] [--database postgresql] [--json FILE]

Makes a capture and a matte, writes copies of their rows into the database, one capture and one matte for ten jobs,
and prints how long the service takes to start on it, and before on an empty folder, the longest of three answers to
each call, and which share of a core the service takes while nobody asks for anything. Last, it queues 2,000 recoveries
and prints how long lists of jobs take then. Run it from the root of the repository.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import httpx2
import psutil
from sqlalchemy import Engine, Table, insert, select

from storage.database import tables
from storage.database.engine import open_engine, reading, writing
from storage.database.rows import new_id
from storage.records import jobs, mattes
from tests.end_to_end.conftest import Service, serving
from tests.parts import postgres
from tests.parts.waiting import until
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

YEAR = 365 * 86400.0
IDLE = 20.0
"""Seconds of watching the service without a request."""
ACTIVE = 2000
"""Recoveries that are queued at once."""
STATES = ("succeeded",) * 7 + ("failed", "cancelled", "cancelled")
"""Of ten composites."""
PATHS = (
    "/v1/captures",
    "/v1/captures?limit=1000",
    "/v1/captures?name=of+no+capture",
    "/v1/captures/{capture}",
    "/v1/mattes",
    "/v1/mattes?limit=1000",
    "/v1/mattes?name=of+no+matte",
    "/v1/mattes?capture={capture}",
    "/v1/mattes/{matte}",
    "/v1/jobs",
    "/v1/jobs?limit=1000",
    "/v1/jobs?limit=1000&after={last}",
    "/v1/jobs?state=running",
    "/v1/jobs?state=failed",
    "/v1/jobs/{job}",
    "/v1/programs",
    "/v1/limits",
    "/v1/cluster",
    "/metrics",
    "/readyz",
)
"""What is asked for."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=1_000_000)
    parser.add_argument("--database", choices=("sqlite", "postgresql"), default="sqlite")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        data = Path(folder, "data")
        environment = {"ENVMATTE_STORE_BYTES": str(10**15), "ENVMATTE_OWNER_BYTES": str(10**15)}
        url = f"sqlite:///{data}/envmatte.db"
        if args.database == "postgresql":
            url = stack.enter_context(postgres.server()).url("postgres")
            environment["ENVMATTE_DATABASE"] = url
        began = time.monotonic()
        with serving(data, **environment) as service:
            found = {"start on an empty folder": time.monotonic() - began}
            archive = Path(folder, "capture.zip")
            monitor = 256, 192
            write_capture(glass_ball(16, 12, monitor=monitor, rays=4), preset("sketch", *monitor), archive)
            capture = service.client.upload(archive)
            service.client.wait(capture["job"])
            service.client.wait(service.client.recover(capture["id"])["id"])
        began = time.monotonic()
        engine = open_engine(url)
        fill(engine, args.jobs)
        engine.dispose()
        print(f"{args.jobs} jobs, written in {time.monotonic() - began:.0f} s", flush=True)
        began = time.monotonic()
        with serving(data, **environment) as service:
            found["start"] = time.monotonic() - began
            found |= dict(timed(service, archive))
            share = idle_share(service)
            found |= busy(service, url, capture["id"])
    for call, seconds in found.items():
        print(f"{call:50} {seconds:7.3f} s")
    print(f"idle: {share:.3f} of a core")
    if args.json:
        args.json.write_text(json.dumps({"seconds": found, "idle": share}, indent=1))


def fill(engine: Engine, count: int) -> None:
    """Copy the rows of the one capture, its matte and its jobs, until there are that many jobs."""
    with reading(engine) as c:
        capture, matte = (
            dict(c.execute(select(one)).mappings().one()) for one in (tables.captures, tables.mattes)
        )
        ingest, recover = (
            dict(c.execute(select(tables.jobs).where(tables.jobs.c.kind == kind)).mappings().one())
            for kind in ("ingest", "recover")
        )
        done = [dict(row) for row in c.execute(select(tables.tiles)).mappings()]
        logged = [dict(row) for row in c.execute(select(tables.log)).mappings()]
    for row in (capture, matte, ingest, recover):
        del row["number"]
    for line in logged:
        del line["line"]

    def groups() -> Iterator[dict[Table, list[dict[str, Any]]]]:
        now = time.time()
        for number in range(count // 10):
            at = now - YEAR * (1 - number / (count // 10))
            ids = [new_id() for _ in range(12)]
            when = {"created_at": at, "started_at": at, "finished_at": at, "stage_at": at, "moved_at": at}
            made = [
                {**ingest, **when, "id": ids[2], "capture": ids[0]},
                {**recover, **when, "id": ids[3], "capture": ids[0], "matte": ids[1]},
            ]
            for id, state in zip(ids[4:], STATES[:8], strict=True):
                one = {**recover, **when, "id": id, "capture": ids[0], "matte": ids[1], "kind": "composite"}
                made.append(one | {"state": state, "stored": 10**6})
            yield {
                tables.captures: [{**capture, "id": ids[0], "job": ids[2], "created_at": at}],
                tables.mattes: [{**matte, "id": ids[1], "capture": ids[0], "job": ids[3], "created_at": at}],
                tables.jobs: made,
                tables.tiles: [
                    {**tile, "job": new}
                    for tile in done
                    for new, old in zip(ids[2:4], (ingest, recover), strict=True)
                    if tile["job"] == old["id"]
                ],
                tables.log: [{**line, "job": one["id"], "at": at} for one in made for line in logged[:4]],
            }

    rows = groups()
    while some := list(islice(rows, 1000)):
        with writing(engine) as c:
            for table in some[0]:
                c.execute(insert(table), [row for group in some for row in group[table]])


def calls(http: httpx2.Client, paths: Sequence[str] = PATHS) -> Iterator[tuple[str, list[float]]]:
    """Each call that reads rows, and the seconds until each of three answers."""
    captures = http.get("/v1/captures").json()
    listed = http.get("/v1/jobs?limit=1000").json()["jobs"]
    ids = {
        "capture": captures["captures"][0]["id"],
        "matte": http.get("/v1/mattes").json()["mattes"][0]["id"],
        "job": listed[0]["id"],
        "last": listed[-1]["id"],
    }
    for path in paths:
        took = []
        for _ in range(3):
            began = time.monotonic()
            answer = http.get(path.format(**ids))
            took.append(time.monotonic() - began)
            assert answer.is_success, answer.text
        yield f"GET {path}", took


def timed(service: Service, archive: Path) -> Iterator[tuple[str, float]]:
    """The longest of three answers to each call, and how long jobs take."""
    http = service.http
    yield from ((call, max(took)) for call, took in calls(http))
    began = time.monotonic()
    uploaded = service.client.upload(archive)
    yield "an upload", time.monotonic() - began
    service.client.wait(uploaded["job"])
    yield "and its ingest", time.monotonic() - began
    began = time.monotonic()
    service.client.wait(service.client.recover(uploaded["id"])["id"])
    yield "a recovery", time.monotonic() - began
    began = time.monotonic()
    assert http.delete(f"/v1/captures/{uploaded['id']}").is_success
    yield "deleting the capture", time.monotonic() - began


def busy(service: Service, url: str, capture: str) -> dict[str, float]:
    """The longest of three answers to lists of jobs while very many are queued or running."""
    engine = open_engine(url)
    with writing(engine) as c:
        options = jobs.get(
            c, c.scalar(select(tables.mattes.c.job).where(tables.mattes.c.capture == capture))
        ).options
        for _ in range(ACTIVE):
            matte = new_id()
            mattes.add(c, matte, capture, jobs.add(c, "recover", capture, options, matte), options)
    engine.dispose()
    until(lambda: service.http.get("/v1/jobs?state=running").json()["jobs"])
    paths = ("/v1/jobs?limit=1000", "/v1/jobs?limit=1000&state=queued", "/v1/jobs?limit=1000&state=running")
    return {f"{call}, of {ACTIVE} active": max(took) for call, took in calls(service.http, paths)}


def idle_share(service: Service) -> float:
    """The share of a core that the service takes when it has nothing to do."""
    process = psutil.Process(service.process.pid)
    used, began = sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(IDLE)
    return (sum(process.cpu_times()[:2]) - used) / (time.monotonic() - began)


if __name__ == "__main__":
    main()
