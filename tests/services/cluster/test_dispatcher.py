"""Tiles submitted to a real cluster, and their outcomes."""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from services.cluster.dispatcher import Dispatcher, Flight, Outcome, _blamed
from services.cluster.embedded import embedded
from services.cluster.task import key_of, read_key
from services.settings import Settings
from storage.errors import Unavailable
from storage.objects.store import Objects
from tests.parts.waiting import until
from workflows.jobs import Task
from workflows.mattes.steps import STEPS
from workflows.untrusted.limits import Limits


def test_the_first_tile_of_a_dead_worker_is_blamed() -> None:
    dead = [
        (Flight("a", [1], 5), "one"),
        (Flight("b", [2], 3), "one"),
        (Flight("a", [3], 4), "two"),
        (Flight("b", [4], 6), "one"),
        (Flight("b", [5], 2, done={5: (0.1, 10)}), "one"),  # its end was not reported any more
    ]
    assert _blamed(dead, {"two"}) == [
        Outcome("a", 1),
        Outcome("b", 2, died="one"),
        Outcome("a", 3, died="two", starved=True),
        Outcome("b", 4),
    ]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalCluster]:
    with embedded(Settings(data=tmp_path_factory.mktemp("data"), workers=1)) as cluster:
        yield cluster


def task(job: str) -> Task:
    return Task(job, "none", "none", {}, Limits(1 << 30, 1 << 26))


def outcomes(dispatcher: Dispatcher, count: int) -> list[Outcome]:
    found: list[Outcome] = []
    end = time.monotonic() + 60
    while len(found) < count:
        assert time.monotonic() < end
        found += dispatcher.collect()
        time.sleep(0.02)
    return found


def test_errors_and_dead_workers_are_reported(cluster: LocalCluster, tmp_path: Path) -> None:
    with Dispatcher(lambda: Client(cluster, set_as_default=False), tmp_path.as_uri()) as dispatcher:
        until(lambda: dispatcher.free == 1)
        dispatcher.submit(STEPS, task("a"), [[3]])
        assert dispatcher.under_way("a") == 1
        (outcome,) = outcomes(dispatcher, 1)
        assert (outcome.job, outcome.tile, outcome.done, outcome.died) == ("a", 3, None, None)
        assert "not in the store" in str(outcome.error)
        assert dispatcher.under_way("a") == 0

        (pid,) = (worker.pid for worker in cluster.workers.values())
        os.kill(pid, signal.SIGSTOP)  # so that it has both when it dies
        dispatcher.submit(STEPS, task("b"), [[1], [2]])
        time.sleep(0.5)
        os.kill(pid, signal.SIGKILL)
        found = sorted(outcomes(dispatcher, 2), key=lambda outcome: outcome.tile)
        assert found[0].died is not None
        assert found[1] == Outcome("b", 2)


def test_of_a_task_of_several_tiles_the_one_that_ended_it_is_blamed(
    cluster: LocalCluster, tmp_path: Path
) -> None:
    def work(objects: Objects, task: Task, tile: int) -> int:
        if tile == 2:
            time.sleep(0.2)
            os.kill(os.getpid(), signal.SIGKILL)
        if tile == 5:
            raise ValueError("odd")
        return 10

    steps = replace(STEPS, work=work)
    with Dispatcher(lambda: Client(cluster, set_as_default=False), tmp_path.as_uri()) as dispatcher:
        until(lambda: dispatcher.free == 1)
        dispatcher.submit(steps, task("a"), [[1, 2, 3]])
        assert dispatcher.under_way("a") == 3
        done, killed, gone = outcomes(dispatcher, 3)
        assert done.done is not None
        assert (done.tile, killed.tile, gone) == (1, 2, Outcome("a", 3))
        assert killed.died is not None
        until(lambda: dispatcher.free == 1)
        dispatcher.submit(steps, task("a"), [[4, 5, 6], [7]])
        found = {outcome.tile: outcome for outcome in outcomes(dispatcher, 4)}
        assert [found[tile].done is not None for tile in range(4, 8)] == [True, False, False, True]
        assert repr(found[5].error) == repr(ValueError("odd"))
        assert found[6] == Outcome("a", 6)


def test_tile_after_a_cancelled_one_does_not_die_with_its_worker(
    cluster: LocalCluster, tmp_path: Path
) -> None:
    def work(objects: Objects, task: Task, tile: int) -> int:
        (tmp_path / f"{task.job}{tile}").touch()
        time.sleep(60 if task.job == "cancelled" else 0)
        return 10

    steps = replace(STEPS, work=work)
    with Dispatcher(lambda: Client(cluster, set_as_default=False), tmp_path.as_uri()) as dispatcher:
        until(lambda: dispatcher.free == 1)
        dispatcher.submit(steps, task("cancelled"), [[1]])
        until((tmp_path / "cancelled1").exists)
        dispatcher.drop("cancelled")
        assert dispatcher.free == 1
        dispatcher.submit(steps, task("a"), [[2]])
        (outcome,) = outcomes(dispatcher, 1)
        assert outcome.done is not None
        assert outcome.died is None


def test_a_missing_scheduler_is_reported_as_a_problem() -> None:
    def connect() -> Client:
        raise Unavailable("no scheduler answers at tcp://127.0.0.1:1")

    with Dispatcher(connect, "file:///store") as dispatcher:
        until(lambda: "no scheduler answers" in dispatcher.cluster["problem"])
        assert (dispatcher.free, dispatcher.threads) == (0, 0)
        assert dispatcher.collect() == []
        dispatcher.drop("a")


def test_only_a_foreign_cluster_without_workers_asks_to_start_some() -> None:
    with (
        LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=None) as empty,
        Dispatcher(lambda: Client(empty, set_as_default=False), "file:///store", lambda tiles: None) as own,
        Dispatcher(lambda: Client(empty, set_as_default=False), "file:///store") as foreign,
    ):
        until(lambda: "no worker is running; the service starts" in own.cluster["problem"])
        until(lambda: "start some with `envmatte worker`" in foreign.cluster["problem"])


def test_keys_are_read_back() -> None:
    assert read_key(key_of("recover", "0ab1", -2)) == ("0ab1", -2)
    assert read_key(key_of("ingest", "0ab1", 12)) == ("0ab1", 12)
    assert key_of("ingest", "0ab1", 12) != key_of("ingest", "0ab1", 12)
    assert read_key("sleep-47ad-b581-4a62-8164") is None
