"""Measures the overhead of a tile: time and memory of the coordinator and the scheduler.

The scheduler and the workers run in their own processes, the coordinator and the database in this one; a tile only
sleeps. Prints a table, and writes JSON to a file if one is named.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import psutil
from sqlalchemy import Connection, event

from services.cluster.connect import connect
from services.cluster.dask_config import configure_dask
from services.cluster.dispatcher import Dispatcher
from services.coordinator.coordinator import Coordinator
from services.settings import Settings
from storage.database.engine import open_engine, reading, writing
from storage.database.rows import new_id
from storage.objects.store import Objects
from storage.records import captures, jobs, mattes
from tests.benchmarks.cluster import simulated


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", type=int, nargs="+", default=[2_000, 10_000, 100_000])
    parser.add_argument("--seconds", type=float, default=0.0, help="That a tile sleeps.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--threads", type=int, default=8, help="Of a worker: sleeping takes no core.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = [measure(tiles, args.seconds, args.workers, args.threads) for tiles in args.tiles]
    names = list(rows[0])
    print("  ".join(f"{name:>22}" for name in names))
    for row in rows:
        print("  ".join(f"{row[name]:>22}" for name in names))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


def measure(tiles: int, seconds: float, workers: int, threads: int) -> dict[str, Any]:
    """Run one simulated job on a fresh database and cluster."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        at = f"tcp://127.0.0.1:{port}"
        scheduler = _started(stack, "services", "scheduler", "--port", str(port))
        for _ in range(workers):
            options = ["--no-dashboard", "--preload", "services.cluster.worker_preload"]
            command = ["distributed.cli.dask_worker", at, "--nthreads", str(threads), *options]
            _started(stack, *command, "--local-directory", str(folder))
        settings = Settings(data=folder, cluster=at, store=(folder / "store").as_uri())
        engine = open_engine(settings.database_url)
        stack.callback(engine.dispose)
        writes = [0]

        def count(connection: Connection) -> None:
            writes[0] += connection.get_execution_options().get("writes", False)

        event.listen(engine, "commit", count)
        objects = Objects(settings.store_url)
        configure_dask()
        simulated.register()
        dispatcher = stack.enter_context(Dispatcher(partial(connect, at, None), settings.store_url))
        while dispatcher.threads < workers * threads:
            time.sleep(0.1)
        stack.enter_context(Coordinator(settings, engine, objects, dispatcher))
        time.sleep(3)
        before = {"here": _cpu(psutil.Process()), "scheduler": _cpu(scheduler)}
        wrote, start = writes[0], time.monotonic()
        with writing(engine) as c:
            capture, matte = new_id(), new_id()
            captures.add(c, capture, "", name="", bytes=0, frames=0, program={})
            captures.change(c, capture, state="ready")
            job = jobs.add(c, "simulated", capture, {"tiles": tiles, "seconds": seconds}, matte)
            mattes.add(c, matte, capture, job, {})
        peak = {"here": 0, "scheduler": 0}
        while True:
            with reading(engine) as c:
                state = jobs.get(c, job).state
            peak["here"] = max(peak["here"], psutil.Process().memory_info().rss)
            peak["scheduler"] = max(peak["scheduler"], scheduler.memory_info().rss)
            if state not in jobs.ACTIVE:
                break
            time.sleep(0.5)
        took = time.monotonic() - start
        assert state == "succeeded", state
        return {
            "tiles": tiles,
            "seconds": round(took, 1),
            "tiles a second": round(tiles / took),
            "coordinator us a tile": round(1e6 * (_cpu(psutil.Process()) - before["here"]) / tiles),
            "scheduler us a tile": round(1e6 * (_cpu(scheduler) - before["scheduler"]) / tiles),
            "coordinator MB": peak["here"] >> 20,
            "scheduler MB": peak["scheduler"] >> 20,
            "writes a second": round((writes[0] - wrote) / took, 1),
        }


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


def _cpu(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONWARNINGS", "ignore")
    main()
