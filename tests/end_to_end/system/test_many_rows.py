"""Lists and metrics of a service that has seen many jobs: they don't take longer with every job."""

from pathlib import Path

import pytest

from storage.database.engine import open_engine, writing
from storage.objects import marker
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes, tiles
from tests.benchmarks.service.many_rows import calls, fill
from tests.end_to_end.conftest import serving
from tests.parts.waiting import until

JOBS = 10_000
SECONDS = 0.5
"""The most that the quickest of three answers may take: it takes longer to read all rows."""


@pytest.mark.slow
def test_calls_read_few_of_many_rows(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    engine = open_engine(f"sqlite:///{data}/envmatte.db")
    with writing(engine) as c:
        for kind, matte in (("ingest", None), ("recover", "m")):
            jobs.add(c, kind, "c", {}, matte, job=kind)
            jobs.enter_stage(c, kind, "preparing")
            tiles.add_steps(c, kind)
            jobs.end(c, kind, "succeeded")
        captures.add(c, "c", "ingest", name="many", bytes=1, frames=1, program={"kind": "made up"})
        captures.change(c, "c", state="ready", width=1, height=1, stored=1)
        mattes.add_imported(c, "m", {}, {}, stored=1)
    fill(engine, JOBS)
    engine.dispose()
    marker.write(Objects((data / "store").as_uri()), "many rows")  # with nothing in it, it would be refused
    with serving(data, "--workers", "1") as service:
        until(lambda: service.http.get("/readyz").is_success)
        assert f'envmatte_captures{{state="ready"}} {JOBS // 10 + 1}' in service.http.get("/metrics").text
        took = dict(calls(service.http))
    assert not {call: seconds for call, seconds in took.items() if min(seconds) > SECONDS}
