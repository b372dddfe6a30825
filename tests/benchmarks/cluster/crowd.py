"""Measures a large cluster: tiles a second, how soon a small job ends beside large ones, and memory.

Scheduler and workers run in processes of their own, the coordinator and the database in this one; a tile only sleeps.
There are always three large jobs, and every now and then a small one. Prints a table, and writes JSON to a file if one
is named. Workers that sleep take more of the machine than scheduler and coordinator do: for a thousand, two cores are
too few.
"""

import argparse
import json
import time
from pathlib import Path
from statistics import median
from typing import Any

from storage.records import jobs
from tests.benchmarks.cluster.simulated import Cluster, simulated_cluster

LARGE, SMALL = 20_000, 80
"""Tiles of a large and of a small job."""
INTERVAL = 20.0
"""Seconds between two small jobs."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=1.0, help="That a tile sleeps.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with simulated_cluster(args.workers) as cluster:
        row = measure(cluster, args.workers, 60 * args.minutes, args.seconds)
    for name, value in row.items():
        print(f"{name:<40}{value:>12}")
    if args.json:
        args.json.write_text(json.dumps(row, indent=2))


def measure(cluster: Cluster, workers: int, duration: float, seconds: float) -> dict[str, Any]:
    """Keep the cluster busy, and look at it."""
    idle = cluster.used()
    time.sleep(10)
    begun, start = cluster.used(), time.monotonic()
    large = [cluster.start(LARGE, seconds) for _ in range(3)]
    small: list[str] = []
    while (now := time.monotonic() - start) < duration:
        if now > INTERVAL * len(small):
            small.append(cluster.start(SMALL, seconds))
        if sum(cluster.job(job).state in jobs.ACTIVE for job in large) < 3:
            large.append(cluster.start(LARGE, seconds))
        time.sleep(0.5)
    took, ended = time.monotonic() - start, cluster.used()
    tiles = sum(cluster.job(job).done for job in large + small)
    rows = [cluster.job(job) for job in small]
    took_each = [row.finished_at - row.created_at for row in rows if row.finished_at]
    figures: dict[str, Any] = {
        "workers": workers,
        "tiles a second": round(tiles / took),
        "workers busy": round(tiles * seconds / took),
        "small jobs ended": f"{len(took_each)} of {len(small)}",
        "small job s, median": round(median(took_each), 1) if took_each else None,
        "small job s, most": round(max(took_each), 1) if took_each else None,
    }
    for name in ("scheduler", "coordinator"):
        share = f"{name} s"
        figures[f"{name}, cores idle"] = round((begun[share] - idle[share]) / 10, 3)
        figures[f"{name}, cores"] = round((ended[share] - begun[share]) / took, 3)
        figures[f"{name} MB at first, at last"] = f"{begun[f'{name} MB']:.0f}, {ended[f'{name} MB']:.0f}"
    return figures


if __name__ == "__main__":
    main()
