"""Measures how times and sizes grow with the pixels of a frame: a traced tumbler at several sizes, through the service.

    python -m tests.benchmarks.recovery.sizes FOLDER [--size 1920x1080 ...] [--quality fast] [--workers 2]
        [--json FILE] [--plot FILE]

Captures of 140 frames are traced, filmed and kept in FOLDER: that of 1920 x 1080 takes minutes and 410 MB. For each
size it prints the pixels of glass; the seconds of the ingest; the seconds until a composite first shows the whole
frame, and until all is recovered, from the request on; the seconds of work for 1,000 pixels; the milliseconds of the
first composite of a service that was just started; the megabytes by which it grew; megabytes that are sent for the live
glass; and milliseconds and rates of composites by number of clients. At last, the exponent with which the recovery's
time grows with the pixels. The plot needs `.[bench]`.
"""

import argparse
import json
import sqlite3
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import psutil

from services.cli.demo_run import service
from services.client import Client, ServiceError
from tests.benchmarks.compositing.composites import backdrops, over_http
from tests.benchmarks.recovery.kits import show
from workflows.programs.presets import preset
from workflows.simulation.samples import GAIN, MONITOR, OFFSET, SAMPLES, film
from workflows.simulation.scene import write_capture

SIZES = ("240x135", "480x270", "960x540", "1920x1080")
SECONDS = 6.0
"""Of each number of clients."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", action="append", metavar="WIDTHxHEIGHT")
    parser.add_argument("--quality", choices=("fast", "fine"), default="fast")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for size in args.size or SIZES:
        rows.append({"size": size} | measure(capture_of(args.folder, size), args.quality, args.workers))
        if len(rows) == 1:
            print("  ".join(f"{name:>8}" for name in rows[0]))
        show(rows[-1])
    if len(rows) > 1:
        pixels, seconds = (np.log([row[name] for row in rows]) for name in ("pixels", "all_s"))
        print(f"time grows with the pixels to the power of {np.polyfit(pixels, seconds, 1)[0]:.2f}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))
    if args.plot:
        plot(rows, args.plot)


def capture_of(folder: Path, size: str) -> Path:
    """The capture archive of a size; made if it is not in the folder."""
    archive = folder / f"tumbler-{size}.zip"
    if not archive.exists():
        width, height = map(int, size.split("x"))
        scene = film(SAMPLES["tumbler"], (width, height))
        part = archive.with_suffix(".part")
        mask = scene.coverage > 0
        write_capture(scene, preset("default", *MONITOR), part, mask=mask, offset=OFFSET, gain=GAIN)
        part.replace(archive)
    return archive


def measure(archive: Path, quality: str, workers: int) -> dict[str, Any]:
    """Ingest, recover and composite a capture."""
    with tempfile.TemporaryDirectory() as name:
        data = Path(name, "data")
        with service(data, workers) as url, Client(url) as client:
            ingested = client.wait(client.upload(archive))
            start = time.perf_counter()
            job = client.recover(ingested.answer["capture"], quality=quality)
            shown = wait_for_whole_frame(client, job.answer["matte"]) - start
            ended = client.wait(job).answer
        with sqlite3.connect(data / "envmatte.db") as ledger:
            query = "select sum(seconds) from tiles where job = ?"
            (seconds,) = ledger.execute(query, (ended["id"],)).fetchone()
        with service(data, workers) as url, Client(url) as client:
            process = psutil.Process().children()[-1]
            before = process.memory_info().rss
            start = time.perf_counter()
            client.composite(ended["matte"], backdrops(1)[0], kind="image/jpeg")
            first = time.perf_counter() - start
            held = process.memory_info().rss - before
            asked = over_http(url, ended["matte"], SECONDS)
            with httpx2.stream("GET", f"{url}/v1/mattes/{ended['matte']}/live", timeout=120) as answer:
                live = sum(map(len, answer.iter_raw()))
    return {
        "pixels": ended["pixels"],
        "ingest_s": round(ingested.answer["run_seconds"], 1),
        "shown_s": round(shown, 1),
        "all_s": round(ended["run_seconds"], 1),
        "s_per_1000": round(seconds / ended["pixels"] * 1000, 3),
        "first_ms": round(1e3 * first),
        "memory_MB": round(held / 1e6),
        "live_MB": round(live / 1e6, 2),
        **{f"p50_{row['clients']}": row["p50 ms"] for row in asked},
        **{f"rate_{row['clients']}": row["a second"] for row in asked},
    }


def wait_for_whole_frame(client: Client, matte: str) -> float:
    """Wait until layers of a matte, or of its preview, are served; returns the time."""
    while True:
        try:
            client.layer(matte, "alpha.png")
            return time.perf_counter()
        except ServiceError as error:
            if error.status != httpx2.codes.CONFLICT:
                raise
        time.sleep(0.1)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Seconds over pixels, on logarithmic axes."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.5))
    pixels = [row["pixels"] for row in rows]
    for name, label in (("ingest_s", "ingest"), ("shown_s", "whole frame shown"), ("all_s", "all recovered")):
        axes.loglog(pixels, [row[name] for row in rows], "o-", label=label)
    axes.set(xlabel="pixels of glass", ylabel="seconds")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    main()
