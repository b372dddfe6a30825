"""Measures how jobs share a cluster: throughput by workers, a small job beside a large one, a cancelled job.

Uses the HTTP service with its own cluster. Prints a table, and writes JSON to a file if one is named.
"""

import argparse
import json
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from services.client import Client
from tests.benchmarks.recovery.kits import served, show
from tests.parts.captures import nested_program
from workflows.images.integer_formats import decode, encode_png
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

BANDS = ((8, 6, 16), (16, 12, 16), (32, 24, 20))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=["throughput", "sharing"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--megapixels", type=float, default=4.2, help="Of the large job.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        if "throughput" in args.parts:
            rows += throughput(Path(folder), args.rounds)
        if "sharing" in args.parts:
            rows += sharing(Path(folder), args.megapixels)
    for row in rows:
        show(row)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


def throughput(folder: Path, rounds: int) -> list[dict[str, Any]]:
    """The same capture with one and with two workers: tiles a second, and the workers' share of time on tiles."""
    capture_archive = folder / "ball.zip"
    write_capture(glass_ball.glass_ball(320, 240, rays=9), preset("default"), capture_archive)
    rows = []
    for n in range(rounds):
        for workers in (1, 2):
            with served(workers) as (client, _):  # one at a time: an idle one takes 5 % of a core
                capture = _ingested(client, capture_archive)
                client.wait(client.recover(capture)["id"])  # loads code that the next finds loaded
                job = client.wait(client.recover(capture)["id"])
            row = {"workers": workers, "round": n, "tiles": job["tiles"]["total"]}
            rows.append(row | {"seconds": round(job["run_seconds"], 2)})
    best = {w: min(row["seconds"] for row in rows if row["workers"] == w) for w in (1, 2)}
    return [*rows, {"efficiency of two": round(best[1] / best[2] / 2, 3)}]


def sharing(folder: Path, megapixels: float) -> list[dict[str, Any]]:
    """A small job alone, beside a large one, and after that one is cancelled while it runs."""
    small, large = folder / "small.zip", folder / "large.zip"
    program = nested_program(bands=BANDS, levels=5)
    write_capture(glass_ball.glass_ball(160, 120, rays=9), program, small)
    enlarge(small, large, megapixels)
    with served(2) as (client, data):
        quick, slow = _ingested(client, small), _ingested(client, large)
        client.wait(client.recover(quick)["id"])
        rows = [{"job": "160 x 120 alone"} | _times(client, quick)]
        job = client.recover(slow)
        _until(lambda: client.job(job["id"])["tiles"]["done"] >= 10)
        rows += [{"job": f"beside one of {megapixels} megapixels"} | _times(client, quick) for _ in range(3)]
        found = client.job(job["id"])
        start = time.monotonic()
        client.cancel(job["id"])
        answered = time.monotonic() - start
        _until(lambda: not (data / "data/store/mattes" / job["matte"]).exists())
        rows.append(
            {
                "cancelled at tile": found["tiles"]["done"],
                "of": found["tiles"]["total"],
                "answered after": round(answered, 2),
                "freed after": round(time.monotonic() - start, 2),
            }
        )
        rows.append({"job": "right after"} | _times(client, quick))
    return rows


def enlarge(source: Path, target: Path, megapixels: float) -> None:
    """The same capture with pixels binned."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(target, "w") as out:
        for name in archive.namelist():
            data = archive.read(name)
            if name.endswith(".png"):
                pixels = decode(data, memory=1 << 28)
                edge = max(round(np.sqrt(megapixels * 1e6 / (pixels.shape[0] * pixels.shape[1]))), 1)
                data = encode_png(np.kron(pixels, np.ones((edge, edge, 1), pixels.dtype)))
            out.writestr(name, data)


def _ingested(client: Client, capture_archive: Path) -> str:
    uploaded = client.upload(capture_archive)
    client.wait(uploaded["job"])
    return str(uploaded["id"])


def _times(client: Client, capture: str) -> dict[str, Any]:
    job = client.recover(capture)
    start = time.monotonic()
    _until(lambda: client.job(job["id"])["tiles"]["done"] > 0)
    first = time.monotonic() - start
    client.wait(job["id"])
    return {"first tile after": round(first, 2), "ended after": round(time.monotonic() - start, 2)}


def _until(true: Callable[[], bool]) -> None:
    while not true():
        time.sleep(0.02)


if __name__ == "__main__":
    main()
