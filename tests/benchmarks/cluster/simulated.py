"""A simulated cluster: real scheduler, coordinator, database and dask workers, and jobs that only take time."""

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil
from sqlalchemy import Engine

from services.cluster.connect import connect
from services.cluster.dask_config import configure_dask
from services.cluster.dispatcher import Dispatcher
from services.coordinator.coordinator import Coordinator
from services.coordinator.job_kinds import JOB_KINDS, JobKind
from services.settings import Settings
from storage.database.engine import open_engine, reading, writing
from storage.database.rows import new_id
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
from workflows.jobs import Steps, Task

WORKERS_A_PROCESS = 100


def prepare(objects: Objects, task: Task) -> dict[str, Any]:
    return {"tiles": task.options["tiles"]}


def work(objects: Objects, task: Task, tile: int) -> int:
    time.sleep(task.options["seconds"])
    return 1000


def missing(objects: Objects, task: Task) -> list[int]:
    return []


def finish(objects: Objects, task: Task) -> dict[str, Any]:
    return {}


class Simulated(JobKind):
    steps = Steps("simulated", "working", prepare, work, missing, finish, scattered=True)


@dataclass
class Cluster:
    """A simulated cluster. Coordinator and database are in this process."""

    engine: Engine
    scheduler: psutil.Process

    def start(self, tiles: int, seconds: float) -> str:
        """Add a job of tiles that sleep; returns its id."""
        with writing(self.engine) as c:
            capture, matte = new_id(), new_id()
            captures.add(c, capture, "", name="", bytes=0, frames=0, program={})
            captures.change(c, capture, state="ready")
            job: str = jobs.add(c, "simulated", capture, {"tiles": tiles, "seconds": seconds}, matte)
            mattes.add(c, matte, capture, job, {})
        return job

    def job(self, id: str) -> Any:
        """The row of a job."""
        with reading(self.engine) as c:
            return jobs.get(c, id)

    def used(self) -> dict[str, float]:
        """Seconds of a core that the coordinator and the scheduler have taken, and the memory that they have, in MB."""
        figures = {}
        for name, process in (("coordinator", psutil.Process()), ("scheduler", self.scheduler)):
            times = process.cpu_times()
            figures[f"{name} s"] = float(times.user + times.system)
            figures[f"{name} MB"] = process.memory_info().rss / 2**20
        return figures


@contextmanager
def simulated_cluster(workers: int) -> Iterator[Cluster]:
    """Run a cluster with workers of one thread each, on a fresh database."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with socket.create_server(("127.0.0.1", 0)) as free:
            at = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        scheduler = _started(stack, "services", "scheduler", "--port", at.rpartition(":")[2])
        for first in range(0, workers, WORKERS_A_PROCESS):
            count = min(WORKERS_A_PROCESS, workers - first)
            _started(stack, "tests.benchmarks.cluster.workers", at, str(count))
        settings = Settings(data=folder, cluster=at, store=(folder / "store").as_uri())
        engine = open_engine(settings.database_url)
        stack.callback(engine.dispose)
        configure_dask()
        JOB_KINDS["simulated"] = Simulated()
        dispatcher = stack.enter_context(Dispatcher(partial(connect, at, None), settings.store_url))
        while dispatcher.threads < workers:
            time.sleep(0.1)
        stack.enter_context(Coordinator(settings, engine, Objects(settings.store_url), dispatcher))
        time.sleep(3)
        yield Cluster(engine, scheduler)


def _started(stack: ExitStack, module: str, *arguments: str) -> psutil.Process:
    process = subprocess.Popen(
        [sys.executable, "-m", module, *arguments], start_new_session=True, stdout=subprocess.DEVNULL
    )

    def end() -> None:
        for one in psutil.Process(process.pid).children(recursive=True):
            one.kill()
        process.kill()
        process.wait()

    stack.callback(end)
    return psutil.Process(process.pid)
