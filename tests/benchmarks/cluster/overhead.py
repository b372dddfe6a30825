"""Measures the overhead of a tile: time and memory of the coordinator and the scheduler.

Scheduler and workers run in processes of their own, the coordinator and the database in this one; a tile only sleeps.
Prints a table, and writes JSON to a file if one is named.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, event

from storage.records import jobs
from tests.benchmarks.cluster.simulated import simulated_cluster


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", type=int, nargs="+", default=[2_000, 10_000, 100_000])
    parser.add_argument("--seconds", type=float, default=0.0, help="That a tile sleeps.")
    parser.add_argument("--workers", type=int, default=16)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = [measure(tiles, args.seconds, args.workers) for tiles in args.tiles]
    names = list(rows[0])
    print("  ".join(f"{name:>22}" for name in names))
    for row in rows:
        print("  ".join(f"{row[name]:>22}" for name in names))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


def measure(tiles: int, seconds: float, workers: int) -> dict[str, Any]:
    """Run one simulated job on a fresh database and cluster."""
    with simulated_cluster(workers) as cluster:
        writes = [0]

        def count(connection: Connection) -> None:
            writes[0] += connection.get_execution_options().get("writes", False)

        event.listen(cluster.engine, "commit", count)
        before, start = cluster.used(), time.monotonic()
        job = cluster.start(tiles, seconds)
        peak = before
        while (state := cluster.job(job).state) in jobs.ACTIVE:
            now = cluster.used()
            peak = {name: max(value, now[name]) for name, value in peak.items()}
            time.sleep(0.5)
        took, after = time.monotonic() - start, cluster.used()
        assert state == "succeeded", state
        return {
            "tiles": tiles,
            "seconds": round(took, 1),
            "tiles a second": round(tiles / took),
            "workers busy": round(tiles * seconds / took),
            **{
                f"{name} us a tile": round(1e6 * (after[f"{name} s"] - before[f"{name} s"]) / tiles)
                for name in ("coordinator", "scheduler")
            },
            **{f"{name} MB": round(peak[f"{name} MB"]) for name in ("coordinator", "scheduler")},
            "writes a second": round(writes[0] / took, 1),
        }


if __name__ == "__main__":
    os.environ.setdefault("PYTHONWARNINGS", "ignore")
    main()
