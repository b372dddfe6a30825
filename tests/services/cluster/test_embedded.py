"""The embedded cluster: where it listens, who can join it, and how many workers it has."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import forkserver
from urllib.parse import urlsplit

import psutil
import pytest
from distributed import LocalCluster

from services.cluster.connect import connect
from services.cluster.embedded import Scale, embedded
from services.settings import Settings
from tests.parts.waiting import until
from tests.services.cluster.clusters import listening


def test_workers_scale_with_tiles_and_stop_when_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    targets: list[int] = []
    scale = Scale(targets.append, 4)
    scale(0)
    now = 400.0
    scale(0)
    scale(0)
    assert targets == [1]
    scale(3)
    scale(2)
    scale(100)
    assert targets == [1, 3, 4]
    now = 600.0
    scale(0)
    assert targets == [1, 3, 4]
    now = 701.0
    scale(0)
    assert targets == [1, 3, 4, 1]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalCluster]:
    with embedded(Settings(data=tmp_path_factory.mktemp("data"), workers=1)) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def sockets(cluster: LocalCluster) -> set[tuple[str, int]]:
    """Where the cluster listens: addresses and ports of the scheduler, in this process, its nanny and its worker."""
    this = psutil.Process()
    return {found for one in (this, *this.children(recursive=True)) for found in listening(one)}


def test_the_embedded_cluster_listens_on_loopback_only(
    cluster: LocalCluster, sockets: set[tuple[str, int]]
) -> None:
    assert urlsplit(cluster.scheduler_address).port in {port for _, port in sockets}
    assert {ip for ip, _ in sockets} == {"127.0.0.1"}
    with connect(cluster.scheduler_address, cluster.security) as client:
        assert list(client.nthreads().values()) == [1]


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user of this machine")
def test_another_user_of_this_machine_cannot_join(
    cluster: LocalCluster, sockets: set[tuple[str, int]]
) -> None:
    ports = [str(port) for _, port in sockets]
    attempts = [sys.executable, "-m", "tests.services.cluster.attempts", *ports]
    # Not that of the fork server, which keeps tests from being found.
    environment = os.environ | {"PYTHONSAFEPATH": ""}
    done = subprocess.run(attempts, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [f"{port} False" for port in ports]


def processes_of(module: str) -> list[psutil.Process]:
    """The children of this process that run a module of multiprocessing."""
    found = []
    for one in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # it has ended since it was listed
            if one.status() != psutil.STATUS_ZOMBIE and module in " ".join(one.cmdline()):
                found.append(one)
    return found


def test_resource_tracker_is_replaced_although_nothing_needs_it(cluster: LocalCluster) -> None:
    (first,) = processes_of("resource_tracker")
    first.kill()
    until(lambda: set(processes_of("resource_tracker")) - {first}, 10)


@pytest.mark.slow
def test_worker_is_replaced_although_the_next_fork_server_dies_too(cluster: LocalCluster) -> None:
    with connect(cluster.scheduler_address, cluster.security) as client:
        before = {*client.run(os.getpid).values()}
        (first,) = processes_of("forkserver")
        first.kill()
        until(lambda: [one for one in processes_of("forkserver") if one != first])
        processes_of("forkserver")[0].kill()  # while it imports what workers need
        until(lambda: {*client.run(os.getpid).values()} - before)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [ConnectionRefusedError, FileNotFoundError, BrokenPipeError])
def test_worker_is_replaced_although_no_fork_server_answers(
    cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch, fault: type[OSError]
) -> None:
    """The server dies in the moment between two steps of a request, which no test can hit from outside."""
    failed: list[str] = []
    take = forkserver.connect_to_new_process

    def connect_to_new_process(files: list[int]) -> tuple[int, int]:
        if not failed:
            failed.append(fault.__name__)
            raise fault
        return take(files)

    with connect(cluster.scheduler_address, cluster.security) as client:
        until(client.nthreads)
        (before,) = client.nthreads()
        monkeypatch.setattr(forkserver, "connect_to_new_process", connect_to_new_process)
        (nanny,) = cluster.workers.values()
        psutil.Process(nanny.pid).kill()
        until(lambda: set(client.nthreads()) - {before}, 60)
    assert failed == [fault.__name__]
