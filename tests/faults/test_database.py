"""PostgreSQL restarts or stays away, or a coordinator misses its lease: two services recover by themselves."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from services.client import Client
from storage.objects.store import Objects
from tests.faults.conftest import Prepared, check, prepare
from tests.parts.postgres import TEMPLATE, Server
from tests.parts.rig import Rig, Row, freeze, thaw
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(3600)

AWAY = 5.0
"""Seconds for which the server is stopped."""
ASLEEP = 15.0
"""Seconds for which a coordinator is frozen: longer than its lease."""


@pytest.fixture(scope="module")
def on_postgresql(
    postgresql_server: Server, tmp_path_factory: pytest.TempPathFactory, capture_archive: Path
) -> Iterator[Prepared]:
    with (
        postgresql_server.database(like=TEMPLATE) as url,
        Rig(tmp_path_factory.mktemp("postgresql"), url) as rig,
    ):
        yield prepare(rig, capture_archive)


@pytest.mark.slow
def test_restarted_database(
    on_postgresql: Prepared, postgresql_server: Server, table: list[Row], times: int
) -> None:
    row = on_postgresql.disturb("restart of PostgreSQL", postgresql_server.restart, times)
    check(table, row)


@pytest.mark.exhaustive
def test_database_that_stays_away(
    on_postgresql: Prepared, postgresql_server: Server, table: list[Row], times: int
) -> None:
    rig = on_postgresql.rig
    answers: set[int] = set()

    def stop() -> None:
        with postgresql_server.stopped():
            end = time.monotonic() + AWAY
            while time.monotonic() < end:
                for url in rig.urls:
                    for path in ("/v1/jobs", "/v1/captures", "/readyz"):
                        answers.add(rig.ask("GET", path, at=url, repeat=False).status_code)
                    assert rig.ask("GET", "/healthz", at=url, repeat=False).status_code == 200

    check(table, on_postgresql.disturb("PostgreSQL stopped, for 5 s", stop, times))
    assert answers == {503}


@pytest.mark.exhaustive
def test_restarted_database_during_an_import(
    on_postgresql: Prepared, postgresql_server: Server, tmp_path: Path, times: int
) -> None:
    """The client repeats what failed, and one matte comes of it."""
    rig, file = on_postgresql.rig, tmp_path / "matte.zip"
    restarts: list[int] = []

    def restart(at: int, sent: int, size: int) -> None:
        if sent * times >= at * size and len(restarts) < at:
            restarts.append(sent)
            postgresql_server.restart()

    with Client(rig.urls[0]) as client:
        (first, *_) = rig.ask("GET", "/v1/mattes").json()["mattes"]
        client.export(first["id"], file)
        for number in range(1, times + 1):
            made = client.import_matte(file, progress=partial(restart, number))
            assert len(restarts) == number
            assert rig.files(made["id"]) == rig.files(first["id"])
    known = {matte["id"] for matte in rig.ask("GET", "/v1/mattes").json()["mattes"]}
    assert set(Objects(rig.store).names("mattes")) - {"zarr.json"} == known


@pytest.mark.exhaustive
def test_late_writer_is_shut_out(on_postgresql: Prepared, table: list[Row], fewer_times: int) -> None:
    rig = on_postgresql.rig
    message = "another coordinator runs the jobs now"

    def sleep() -> None:
        name = rig.leader()
        before, end = rig.log(name).count(message), time.monotonic() + ASLEEP
        other = rig.urls[1 - int(name[-1])]
        freeze(rig.process(name))
        try:
            job = rig.ask("GET", "/v1/jobs?limit=1", at=other).json()["jobs"][0]["id"]
            until(lambda: rig.job(job, at=other)["state"] == "succeeded" and time.monotonic() > end)
            record = [rig.ask("GET", f"/v1/jobs/{job}{more}", at=other).json() for more in ("", "/log")]
        finally:
            thaw(rig.process(name))
        until(lambda: rig.log(name).count(message) > before)
        time.sleep(1)  # time to do what it was about to do when frozen
        assert rig.log(name).count(message) == before + 1
        assert rig.leader() != name
        assert record == [rig.ask("GET", f"/v1/jobs/{job}{more}").json() for more in ("", "/log")]

    check(table, on_postgresql.disturb("SIGSTOP of a coordinator, for 15 s", sleep, fewer_times))
