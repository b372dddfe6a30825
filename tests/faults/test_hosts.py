"""Links between hosts are cut silently and restored: jobs end, and the hosts rejoin."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.database.engine import open_engine, reading
from storage.records import leases
from tests.faults.conftest import Prepared, check, prepare
from tests.parts.hosts import Hosts
from tests.parts.rig import Row
from tests.parts.waiting import until

pytestmark = pytest.mark.timeout(3600)

AWAY = 20.0
"""Seconds for which a link is cut: longer than dask waits for an answer."""


@pytest.fixture(scope="module")
def hosts(tmp_path_factory: pytest.TempPathFactory, capture_archive: Path) -> Iterator[Prepared]:
    with Hosts(tmp_path_factory.mktemp("hosts")) as rig:
        yield prepare(rig, capture_archive)


@pytest.mark.parametrize("name", ["service0", "scheduler"])
@pytest.mark.exhaustive
def test_cut_link_of_service_or_scheduler(
    hosts: Prepared, table: list[Row], fewer_times: int, name: str
) -> None:
    cut_off(hosts, table, name, fewer_times)


@pytest.mark.exhaustive
def test_cut_link_of_a_worker(hosts: Prepared, table: list[Row], fewer_times: int) -> None:
    cut_off(hosts, table, "worker0", fewer_times)


def cut_off(hosts: Prepared, table: list[Row], name: str, times: int) -> None:
    assert isinstance(hosts.rig, Hosts)
    network = hosts.rig.network

    def cut() -> None:
        network.cut(name)
        time.sleep(AWAY)
        network.mend(name)

    row = hosts.disturb(f"the link of {name} cut, for 20 s", cut, times)
    until(lambda: workers_of(hosts.rig.folder / "data" / "envmatte.db") == 2)
    check(table, row)


def workers_of(ledger: Path) -> int:
    """The number of workers that the coordinator sees."""
    engine = open_engine(f"sqlite:///{ledger}")
    with reading(engine) as c:
        heartbeat = leases.last_heartbeat(c)
    engine.dispose()
    return len(heartbeat.cluster["workers"]) if heartbeat else 0
