"""A day of a service in minutes: nothing it holds grows, and nothing is left once everything has expired.

    python -m tests.benchmarks.soak.soak [--hours 24] [--minutes 8] [--json FILE]

A scheduler, two workers and a service in their own processes, and many users (`users`) that upload, recover,
composite, cancel, disconnect and send invalid data. Captures, mattes, uploads and jobs are kept for two to three
simulated hours, and workers are killed now and then. At the end of each hour the memory, open files and threads of
every process are measured, and the rows of every table and the objects in the store are counted. From the middle of
the day on, none of them may grow; for workers, rows and the store only the last quarter counts, in which no worker is
killed and no job cancelled. Then the users stop, and everything that expires must be gone.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil
from sqlalchemy import func, select

from storage.database import tables
from storage.database.engine import open_engine, reading
from tests.benchmarks.service.traffic import Traffic
from tests.benchmarks.soak import users
from tests.benchmarks.soak.trends import Trend, trend
from tests.parts.rig import free_port, url_of
from tests.services.cluster.clusters import started, workers
from tests.services.webhooks.receivers import receiver

WORKERS = 2
MB = 1e6
KEPT = {"CAPTURE": 3.0, "MATTE": 3.0, "JOB": 3.0, "UPLOAD": 2.0}
"""Simulated hours for which data are kept, by setting."""
LASTING = {"coordinator", "totals"}
"""Tables that keep a few rows."""
ALLOWED = {
    "MB": {"least": 4.0, "share": 0.03},
    "files": {"least": 3.0, "share": 0.0},
    "threads": {"least": 3.0, "share": 0.0},
    "store's threads": {"least": 10.0, "share": 0.5},
    "rows": {"least": 20.0, "share": 0.5},
    "objects": {"least": 300.0, "share": 0.5},
    "bytes": {"least": 300e3, "share": 0.5},
}
"""Growth that is tolerated, by quantity.

obstore keeps as many threads as its busiest moment took. Rows and bytes follow the traffic; at the end all are gone.
"""
STORE = "tokio-rt-worker"
"""Name of obstore's threads."""
PATIENCE = 300.0
"""Seconds that the last data may outlive their expiry."""
Sample = dict[str, float]
MISSING = float("nan")


@dataclass
class Running:
    """The processes of a service."""

    url: str
    data: Path
    processes: dict[str, psutil.Process]
    workers: Any

    def named(self) -> Iterator[tuple[str, list[psutil.Process]]]:
        """The processes by role."""
        for name, process in self.processes.items():
            yield name, [process]
        yield "worker", workers(self.workers)
        own = psutil.Process(self.workers.pid).children()  # they live as long as it does
        yield "fork server", [one for one in own if any("forkserver" in word for word in one.cmdline())]


@contextmanager
def running(folder: Path, hour: float) -> Iterator[Running]:
    """A scheduler, workers and a service."""
    at = f"tcp://127.0.0.1:{free_port()}"
    kept = {f"ENVMATTE_{name}_SECONDS": str(max(round(hours * hour), 1)) for name, hours in KEPT.items()}
    environment = kept | {
        "ENVMATTE_MATTE_MEMORY": str(8 << 20),
        "ENVMATTE_WEBHOOK_SECRET": "a secret of sixteen and more",
        "ENVMATTE_WEBHOOK_PRIVATE": "true",
    }
    with ExitStack() as stack:

        def start(name: str, *command: str, **environment: str) -> Any:
            return stack.enter_context(started(folder / f"{name}.log", *command, **environment))

        scheduler = start("scheduler", "scheduler", "--port", at.rsplit(":", 1)[1])
        nannies = start("workers", "worker", "--cluster", at, "--workers", str(WORKERS))
        service = start(
            "service", "serve", "--port", "0", "--data", str(folder / "data"), "--cluster", at, **environment
        )
        processes = {"API": service, "scheduler": scheduler, "nannies": nannies}
        url = url_of(service)
        found = {name: psutil.Process(process.pid) for name, process in processes.items()}
        yield Running(url, folder / "data", found, nannies)


def threads_of(process: psutil.Process) -> list[str]:
    """Names of a process's threads."""
    names = []
    for task in Path(f"/proc/{process.pid}/task").glob("*/comm"):
        with suppress(OSError):  # the thread has ended
            names.append(task.read_text().strip())
    return names


def memory_of(name: str, process: psutil.Process) -> int:
    """Private memory of a process in bytes; for the fork server including what it shares with workers."""
    return int(process.memory_info().rss if name == "fork server" else process.memory_full_info().uss)


def take_sample(service: Running) -> Sample:
    """Measure everything that may grow."""
    sample: Sample = {}
    for name, processes in service.named():
        held: list[tuple[float, int, int, int]] = []
        for one in processes:
            with suppress(psutil.NoSuchProcess):
                names = threads_of(one)
                of_store = names.count(STORE)
                held.append((memory_of(name, one) / MB, one.num_fds(), len(names) - of_store, of_store))
        if held:
            memory, files, threads, stores = zip(*held, strict=True)
            found = {"MB": sum(memory) / len(memory), "files": max(files), "threads": max(threads)}
            found["store's threads"] = max(stores)
            sample |= {f"{name}: {what}": value for what, value in found.items()}
    engine = open_engine(f"sqlite:///{service.data / 'envmatte.db'}")
    with reading(engine) as c:
        for table in tables.metadata.sorted_tables:
            sample[f"{table.name}: rows"] = c.scalar(select(func.count()).select_from(table)) or 0
    engine.dispose()
    for file in ("envmatte.db", "envmatte.db-wal"):
        with suppress(FileNotFoundError):
            sample[f"{file}: bytes"] = (service.data / file).stat().st_size
    sizes = [0]
    for folder, _, names in os.walk(service.data / "store"):  # os.walk skips what is deleted meanwhile
        for name in names:
            with suppress(FileNotFoundError):
                sizes.append(Path(folder, name).stat().st_size)
    return sample | {"store: objects": len(sizes) - 1, "store: bytes": sum(sizes)}


def run_day(service: Running, traffic: Traffic, hours: int, hour: float) -> list[Sample]:
    """Run the day; takes a sample every hour."""
    samples: list[Sample] = []
    begun = time.monotonic()
    for n in range(1, hours + 1):
        traffic.gentle = n > 2 * hours // 3
        if n % 4 == 2 and not traffic.gentle:
            killed = workers(service.workers)[:1]
            for one in killed:
                one.kill()
            traffic.done["kill a worker"] += len(killed)
        time.sleep(max(0.0, begun + n * hour - time.monotonic()))
        samples.append(take_sample(service))
        show(n, samples[-1], traffic)
    return samples


def leftovers(service: Running, hour: float) -> Sample:
    """Data that should have expired but still exist."""
    end = time.monotonic() + max(KEPT.values()) * hour + PATIENCE
    while True:
        sample = take_sample(service)
        rows = {
            f"{table.name}: rows": sample[f"{table.name}: rows"]
            for table in tables.metadata.sorted_tables
            if table.name not in LASTING
        }
        found = {name: value for name, value in rows.items() if value}
        stored = sample["store: bytes"]
        if stored > 4000:  # besides the folders' own zarr.json
            found["store: bytes"] = stored
        if not found or time.monotonic() > end:
            return found
        time.sleep(1)


def trends_of(samples: list[Sample]) -> dict[str, Trend]:
    """The trend of every quantity over the hours that count.

    While no job is cancelled and no worker killed there is more of everything: for workers and data only those hours
    count.
    """
    trends = {}
    for name in samples[-1]:
        late = name.startswith("worker:") or name.endswith((": rows", ": objects", ": bytes"))
        first = 3 * len(samples) // 4 if late else len(samples) // 2
        values = [sample[name] for sample in samples[first:] if name in sample]
        trends[name] = trend(values, **ALLOWED[name.rsplit(": ", 1)[1]])
    return trends


COLUMNS = ("API", "scheduler", "nannies", "fork server", "worker")


def show(hour: int, sample: Sample, traffic: Traffic) -> None:
    """Print a line of the table: of each process private MB, open files and threads."""
    if hour == 1:
        heads = [f"{name:>16}" for name in COLUMNS]
        print(
            "hour    done",
            *heads,
            f"{'captures':>9}{'mattes':>7}{'jobs':>6}{'rows':>7}{'db kB':>7}{'objects':>8}{'kB':>7}",
        )
    held = [
        "/".join(f"{sample.get(f'{name}: {what}', MISSING):.0f}" for what in ("MB", "files", "threads"))
        for name in COLUMNS
    ]
    rows = sum(value for name, value in sample.items() if name.endswith(": rows"))
    kept = [sample[f"{name}: rows"] for name in ("captures", "mattes", "jobs")]
    print(
        f"{hour:4}{sum(traffic.done.values()):8}",
        *(f"{one:>16}" for one in held),
        f"{kept[0]:9}{kept[1]:7}{kept[2]:6}{rows:7}{sample['envmatte.db: bytes'] / 1e3:7.0f}"
        f"{sample['store: objects']:8}{sample['store: bytes'] / 1e3:7.0f}",
        flush=True,
    )


def verdict(trends: dict[str, Trend], remains: Sample, wrong: list[str]) -> list[str]:
    """The problems found, in words."""
    problems = [
        f"{name} grows: from {one.first:.1f} to {one.last:.1f}, ± {one.error:.1f}; {one.allowed:.1f} is allowed"
        for name, one in trends.items()
        if one.grows
    ]
    problems += [f"{name}: {value:.0f} are left when all has expired" for name, value in remains.items()]
    return problems + [f"answered wrongly: {one}" for one in sorted(set(wrong))]


def soak(hours: int, minutes: float, folder: Path, seed: int = 1) -> dict[str, Any]:
    """Run the day and report it."""
    hour = 60 * minutes / hours
    with receiver(lambda n: 500 if n % 8 == 5 else 200) as webhooks, running(folder, hour) as service:
        traffic = Traffic(service.url, webhooks.url, folder, users.ALL, pause=hour / 20, seed=seed)
        with traffic:
            samples = run_day(service, traffic, hours, hour)
        remains = leftovers(service, hour)
        samples.append(take_sample(service))
    trends = trends_of(samples[:-1])
    return {
        "hours": hours,
        "minutes": minutes,
        "done": dict(sorted(traffic.done.items())),
        "webhooks": len(webhooks.received),
        "samples": samples,
        "trends": {name: asdict(one) | {"grows": one.grows} for name, one in trends.items()},
        "problems": verdict(trends, remains, traffic.wrong),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=int, default=24)
    parser.add_argument("--minutes", type=float, default=8.0, help="Minutes that they take.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--logs", type=Path, help="A folder for the processes' logs and data, to be looked at afterwards."
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = soak(args.hours, args.minutes, args.logs or Path(folder), args.seed)
    print("\n" + ", ".join(f"{what}: {number}" for what, number in found["done"].items()))
    print(f"webhooks delivered: {found['webhooks']}\n")
    print(f"{'':34}{'middle':>12}{'end':>12}{'error':>10}{'allowed':>10}")
    for name, one in found["trends"].items():
        mark = "  grows" if one["grows"] else ""
        print(
            f"{name:34}{one['first']:12.1f}{one['last']:12.1f}{one['error']:10.1f}{one['allowed']:10.1f}{mark}"
        )
    if args.json:
        args.json.write_text(json.dumps(found, indent=2))
    print("\n".join(["", *found["problems"]] if found["problems"] else ["", "flat"]))
    sys.exit(bool(found["problems"]))


if __name__ == "__main__":
    main()
