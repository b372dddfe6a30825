"""A scheduler and workers in their own processes: who can connect, and that killed processes are replaced."""

import asyncio
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest
from distributed import Client, Scheduler, Worker
from distributed.scheduler import KilledWorker
from distributed.security import Security

from services.cluster.connect import connect
from services.runtime import certificates
from storage.errors import Unavailable
from tests.parts.processes import alive
from tests.parts.rig import free_port
from tests.parts.waiting import until
from tests.services.cluster.attempts import answers_without_certificate, gets_in
from tests.services.cluster.clusters import address, children, listening, started, workers

WORKERS = 2


@dataclass
class Cluster:
    """A scheduler that can be killed and restarted, and workers."""

    folder: Path
    security: Security
    address: str
    workers: subprocess.Popen[str]
    scheduler: subprocess.Popen[str]
    ending: ExitStack

    def kill_scheduler(self) -> None:
        """Kill the scheduler, as a crash would."""
        self.ending.close()

    def start_scheduler(self) -> None:
        """Start the scheduler again at the same address."""
        self.scheduler = self.ending.enter_context(scheduling(self.folder, urlsplit(self.address).port or 0))
        address(self.scheduler)

    @property
    def log(self) -> str:
        """What the workers have logged so far."""
        return (self.folder / "workers.log").read_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cluster")
    certificates.make(folder / "certs")
    certificates.make(folder / "others")
    return folder


@contextmanager
def scheduling(folder: Path, port: int = 0, host: str = "0.0.0.0") -> Iterator[subprocess.Popen[str]]:
    options = ("--host", host, "--port", str(port), "--certs", str(folder / "certs"))
    with started(folder / "scheduler.log", "scheduler", *options) as process:
        yield process


@contextmanager
def working(folder: Path, at: str, *options: str, **environment: str) -> Iterator[subprocess.Popen[str]]:
    command = ("worker", "--cluster", at, "--certs", str(folder / "certs"), *options)
    with started(folder / "workers.log", *command, **environment) as process:
        yield process


@pytest.fixture(scope="module")
def cluster(folder: Path) -> Iterator[Cluster]:
    """Workers that start before their scheduler, and wait for it."""
    port = free_port()
    at = f"tls://127.0.0.1:{port}"
    (folder / "workers.log").touch()
    with working(folder, at, "--workers", str(WORKERS), "--host", "0.0.0.0") as these:
        until(lambda: "waiting for the scheduler" in (folder / "workers.log").read_text(), by=these)
        with ExitStack() as ending:
            scheduler = ending.enter_context(scheduling(folder, port))
            assert urlsplit(address(scheduler)).port == port
            yield Cluster(folder, certificates.security_of(folder / "certs"), at, these, scheduler, ending)


@pytest.fixture
def client(cluster: Cluster) -> Iterator[Client]:
    with connect(cluster.address, cluster.security) as client:
        until(lambda: len(client.nthreads()) == WORKERS)
        yield client


@pytest.mark.slow
def test_sockets_accept_only_certificates_of_the_cluster(cluster: Cluster, client: Client) -> None:
    own = {urlsplit(name).port for name in client.nthreads()}
    info = client.scheduler_info(n_workers=-1)["workers"].values()
    own |= {urlsplit(one["nanny"]).port for one in info} | {urlsplit(cluster.address).port}
    assert len(own) == 1 + 2 * WORKERS
    processes = [psutil.Process(p.pid) for p in (cluster.scheduler, cluster.workers)]
    processes += [*children(cluster.scheduler), *children(cluster.workers)]
    found = {port: ip for process in processes for ip, port in listening(process)}
    assert own <= found.keys()
    assert {ip for port, ip in found.items() if port not in own} <= {"127.0.0.1", "::1"}
    others = certificates.security_of(cluster.folder / "others")

    async def attempts(port: int) -> list[bool]:
        return await asyncio.gather(
            gets_in(f"tls://127.0.0.1:{port}", cluster.security),
            gets_in(f"tls://127.0.0.1:{port}", others),
            gets_in(f"tcp://127.0.0.1:{port}", Security()),
            answers_without_certificate(port),
        )

    async def all_ports() -> list[list[bool]]:
        return await asyncio.gather(*(attempts(port) for port in found))

    for port, got_in in zip(found, asyncio.run(all_ports()), strict=True):
        assert got_in == [port in own, False, False, False], (port, own)


def test_a_client_of_another_cluster_gets_an_error(cluster: Cluster) -> None:
    with pytest.raises(Unavailable, match="same certificates"):
        connect(cluster.address, certificates.security_of(cluster.folder / "others"))
    with pytest.raises(Unavailable, match="no scheduler answers at tcp"):
        connect("tcp://127.0.0.1:9", None)


@pytest.mark.slow
def test_server_that_does_not_answer_is_unavailable() -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        with pytest.raises(Unavailable, match="no scheduler answers"):
            connect(f"tcp://127.0.0.1:{silent.getsockname()[1]}", None)


def test_a_killed_worker_process_is_replaced(cluster: Cluster, client: Client) -> None:
    before = client.nthreads().keys()
    workers(cluster.workers)[0].kill()
    until(lambda: len(client.nthreads().keys() - before) == 1 and len(client.nthreads()) == WORKERS)
    assert client.submit(sum, [1, 2]).result(60) == 3


@pytest.mark.exhaustive
def test_workers_join_a_restarted_scheduler(cluster: Cluster, client: Client) -> None:
    busy = client.submit(time.sleep, 3)
    for _ in range(2):
        cluster.kill_scheduler()
        before = cluster.log.count("waiting for the scheduler")
        until(lambda before=before: cluster.log.count("waiting for the scheduler") > before)
        cluster.start_scheduler()
        with connect(cluster.address, cluster.security) as again:
            until(lambda again=again: len(again.nthreads()) == WORKERS)
            assert again.submit(sum, [1, 2]).result(60) == 3
    assert busy.status != "finished"


@pytest.mark.slow
def test_finished_tasks_leave_almost_nothing_in_memory(cluster: Cluster, client: Client) -> None:
    """Each is submitted alone, like the last tiles of a job."""

    def kept(dask_scheduler: Scheduler) -> int:
        import gc

        from distributed.scheduler import TaskGroup

        gc.collect()
        return sum(type(one) is TaskGroup for one in gc.get_objects())

    def counted(dask_worker: Worker) -> int:
        return len(dask_worker.digests_total)

    def bursts(number: int) -> None:
        for _ in range(number):
            assert client.submit(pow, 2, 3, pure=False).result(timeout=60) == 8

    bursts(1)
    before = sum(client.run(counted).values())
    bursts(150)
    until(lambda: client.run_on_scheduler(kept) < 15)
    assert sum(client.run(counted).values()) < before + 50


@pytest.mark.slow
def test_task_over_the_memory_limit_is_blamed_at_once(cluster: Cluster, client: Client) -> None:
    limit = 700 << 20
    with working(
        cluster.folder, cluster.address, "--workers", "1", ENVMATTE_WORKER_MEMORY=str(limit)
    ) as process:
        until(lambda: len(client.nthreads()) == WORKERS + 1)
        (small,) = [
            name
            for name, one in client.scheduler_info(n_workers=-1)["workers"].items()
            if one["memory_limit"] == limit
        ]
        before = workers(process)
        greedy = client.submit(lambda: time.sleep(60 if bytearray(limit * 2) else 0), workers=[small])
        with pytest.raises(KilledWorker):
            greedy.result(60)
        until(lambda: workers(process) and workers(process) != before)
    # The coordinator has it done again.
    assert "ERROR" not in (cluster.folder / "scheduler.log").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_workers_that_are_stopped_leave_nothing_and_give_back_their_tasks(
    cluster: Cluster, client: Client, tmp_path: Path, number: signal.Signals
) -> None:
    before, logged = client.nthreads().keys(), len(cluster.log)
    with working(cluster.folder, cluster.address, "--workers", "2", TMPDIR=str(tmp_path)) as process:
        until(lambda: len(client.nthreads()) == WORKERS + 2)
        assert any(tmp_path.iterdir())
        these = client.nthreads().keys() - before
        busy = [client.submit(time.sleep, 1000, workers=[one], pure=False) for one in these]
        until(lambda: all(client.processing()[one] for one in these))
        tree = children(process)
        process.send_signal(number)
        assert process.wait(60) == (0 if number == signal.SIGTERM else 130)
        assert not any(tmp_path.iterdir())
        until(lambda: not alive(tree))
        until(lambda: len(client.nthreads()) == WORKERS)
        assert [task.status for task in busy] == ["pending"] * 2
        client.cancel(busy)
    assert not {"ERROR", "WARNING", "Traceback"} & {*cluster.log[logged:].split()}


@pytest.mark.slow
def test_starting_workers_stop_at_sigterm(cluster: Cluster, tmp_path: Path) -> None:
    with working(cluster.folder, cluster.address, "--workers", "2", TMPDIR=str(tmp_path)) as process:
        until(lambda: len(workers(process)) == 2)
        tree = children(process)
        process.terminate()
        assert process.wait(60) == 0
        assert not any(tmp_path.iterdir())
        until(lambda: not alive(tree))


@pytest.mark.slow
def test_workers_die_with_their_nanny(cluster: Cluster, client: Client) -> None:
    with working(cluster.folder, cluster.address, "--workers", "2") as process:
        until(lambda: len(client.nthreads()) == WORKERS + 2)
        tree = children(process)
        assert len(tree) >= 2
        process.kill()
        until(lambda: not alive(tree))
    until(lambda: len(client.nthreads()) == WORKERS)


@pytest.mark.exhaustive
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_waiting_workers_stop_at_signals(folder: Path, number: signal.Signals) -> None:
    (folder / "workers.log").write_text("")
    with working(folder, "tls://127.0.0.1:9", "--workers", "2") as process:
        log = folder / "workers.log"
        until(lambda: "waiting for the scheduler at tls://127.0.0.1:9" in log.read_text(), by=process)
        process.send_signal(number)
        assert process.wait(60) == (0 if number == signal.SIGTERM else 130)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_scheduler_stops_at_signals(folder: Path, number: signal.Signals) -> None:
    with scheduling(folder, host="127.0.0.1") as process:
        assert address(process).startswith("tls://127.0.0.1:")
        process.send_signal(number)
        assert process.wait(60) == (0 if number == signal.SIGTERM else 130)


@pytest.mark.exhaustive
def test_a_scheduler_without_certificates_listens_on_loopback_only(tmp_path: Path) -> None:
    data = {"ENVMATTE_DATA": str(tmp_path)}
    with started(tmp_path / "log", "scheduler", "--host", "0.0.0.0", **data) as process:
        assert process.wait(60) == 2
    assert "envmatte certs" in (tmp_path / "log").read_text()
    with started(tmp_path / "log", "scheduler", "--port", "0", **data) as process:
        at = address(process)
        assert {ip for ip, _ in listening(psutil.Process(process.pid))} == {"127.0.0.1"}
        with started(tmp_path / "log", "worker", "--cluster", at, "--host", "0.0.0.0", **data) as refused:
            assert refused.wait(60) == 2
        assert "without TLS" in (tmp_path / "log").read_text()
        with (
            started(tmp_path / "log", "worker", "--cluster", at, "--workers", "1", **data) as worker,
            connect(at, None) as client,
        ):
            until(lambda: client.nthreads())
            for one in (psutil.Process(worker.pid), *children(worker)):
                assert {ip for ip, _ in listening(one)} <= {"127.0.0.1"}


def test_a_port_in_use_is_reported(folder: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        (folder / "scheduler.log").write_text("")
        with scheduling(folder, taken.getsockname()[1], "127.0.0.1") as process:
            assert process.wait(60) == 4
    log = (folder / "scheduler.log").read_text()
    assert "choose another port with --port" in log
    assert "Traceback" not in log
