"""Measures composites: the kernel beside a plain copy and scipy's product, requests, memory and the cache.

    python -m tests.benchmarks.compositing.composites [--archive NAME=CAPTURE.zip ...] [--large 1.0] [--json FILE]

Recovers through a real service a traced glass ball of 640 x 480 pixels, one enlarged to some megapixels, and
each named capture archive; then measures in this process and over HTTP. Run it from the root of the repository.
"""

import argparse
import json
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import psutil
import scipy.sparse as sp

from services.cli.demo_run import service
from services.client import Client
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.benchmarks.cluster.sharing import enlarge
from workflows.composite import Backdrop
from workflows.composite.backdrops.backdrop import node_light
from workflows.composite.cache import Cache
from workflows.composite.engine import Window, compose
from workflows.composite.strips import LENGTH
from workflows.images import integer_formats
from workflows.images.tone_curves import table
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture
from workflows.threads import CORES


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--archive", action="append", default=[], metavar="NAME=CAPTURE.zip")
    parser.add_argument("--large", type=float, default=1.0, help="Megapixels of the enlarged matte.")
    parser.add_argument("--seconds", type=float, default=8.0, help="Of each number of clients.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        archives = {one.partition("=")[0]: Path(one.partition("=")[2]) for one in args.archive}
        archives["ball 640 x 480"] = folder / "ball.zip"
        write_capture(glass_ball.glass_ball(640, 480, rays=9), preset("quick"), archives["ball 640 x 480"])
        if args.large:
            archives[f"{args.large} megapixels"] = folder / "large.zip"
            small = folder / "small.zip"
            write_capture(glass_ball.glass_ball(160, 120, rays=9), preset("quick"), small)
            enlarge(small, folder / "large.zip", args.large)
        data = folder / "data"
        with service(data, CORES) as url, Client(url) as client:
            mattes = {}
            for title, capture_archive in archives.items():
                made = client.upload(capture_archive)
                client.wait(made["job"])
                mattes[title] = client.wait(client.recover(made["id"], quality="fast")["id"])["matte"]
                print(f"recovered {title}", flush=True)
            objects = Objects((data / "store").as_uri())
            for title, matte in mattes.items():
                rows.append({"matte": title} | kernel(objects, matte))
                print(json.dumps(rows[-1]), flush=True)
            rows += over_http(url, mattes["ball 640 x 480"], args.seconds)
            rows.append({"cache at half a matte": twice(objects, mattes["ball 640 x 480"])})
        with service(data, CORES) as url, Client(url) as client:
            rows.append({"first request after start, ms": first(client, mattes["ball 640 x 480"])})
    for row in rows[len(mattes) :]:
        print(json.dumps(row))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


def best(work: Callable[[], Any], rounds: int = 15) -> float:
    """Milliseconds of the fastest of several runs."""
    work()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def kernel(objects: Objects, id: str) -> dict[str, Any]:
    """T L of a matte in memory: this project's, a copy of the same bytes, and scipy's product of its rows."""
    matte = Matte(objects, id)
    cache = Cache(objects, 1 << 34)
    numbers = range(-(-matte.width // LENGTH))
    strips = [cache.strip(id, row, number) for row in range(matte.block_rows) for number in numbers]
    codes = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    backdrop = Backdrop(codes, table("srgb", np.dtype(np.uint8)))
    light = node_light(backdrop, matte.columns, matte.rows, CORES)
    # Rows that are equal in all channels are one row for scipy too.
    blocks = [matte.read(row, column) for row, column in np.ndindex(matte.block_rows, matte.block_columns)]
    count = np.concatenate([block.count.reshape(-1) for block in blocks]).astype(np.int64)
    cell, weight = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("cell", "weight"))
    rows = sp.csr_array(
        (weight, cell.astype(np.int32), np.append(0, np.cumsum(count))), (len(count), len(light))
    )
    packed = [
        np.concatenate([getattr(strip, name) for strip in strips]) for name in ("first", "step", "code")
    ]
    window = Window.of(matte)

    def run(threads: int) -> float:
        return best(lambda: compose(matte, light, window, partial(cache.strip, id), threads))

    one, all_cores = run(1), run(CORES)
    taken = sum(array.nbytes for array in packed)
    return {
        "pixels": matte.width * matte.height,
        "entries a pixel": round(len(cell) / (matte.width * matte.height), 1),
        "bytes in memory": cache.bytes,
        "copy of T, ms": round(best(lambda: [array.copy() for array in packed]), 2),
        "scipy's product, ms": round(scipy_ms := best(lambda: rows @ light), 2),
        "one thread, ms": round(one, 2),
        f"{CORES} threads, ms": round(all_cores, 2),
        "bytes of T a second": f"{taken / all_cores * 1e3:.3g}",
        "scipy / ours": round(scipy_ms / all_cores, 2),
        "light, ms": round(best(lambda: node_light(backdrop, matte.columns, matte.rows, CORES)), 2),
    }


def backdrops(count: int) -> list[bytes]:
    """JPEGs of 640 x 480, all different."""
    picture = integer_formats.to_integers(glass_ball.backdrop(640, 480), np.dtype(np.uint8))
    return [integer_formats.encode_jpeg(np.roll(picture, 7 * n, axis=1), 90) for n in range(count)]


def over_http(url: str, matte: str, seconds: float) -> list[dict[str, Any]]:
    """Milliseconds per request and requests per second, by number of clients that ask without pause."""
    sent, rows = backdrops(16), []
    for clients in (1, 8, 32):
        times: list[float] = []
        gate = threading.Barrier(clients)

        def ask(number: int, gate: Any = gate, times: list[float] = times) -> None:
            with httpx2.Client(base_url=url, timeout=60, headers={"Accept": "image/jpeg"}) as http:
                http.post(f"/v1/mattes/{matte}/composite", content=sent[0])
                gate.wait()
                n, end = number, time.monotonic() + seconds
                while time.monotonic() < end:
                    start = time.perf_counter()
                    answer = http.post(f"/v1/mattes/{matte}/composite", content=sent[n % len(sent)])
                    times.append(time.perf_counter() - start)
                    assert answer.status_code == 200
                    n += 1

        with ThreadPoolExecutor(clients) as threads:
            list(threads.map(ask, range(clients)))
        times.sort()
        rows.append(
            {
                "clients": clients,
                "requests": len(times),
                "a second": round(len(times) / seconds, 1),
                "p50 ms": round(1e3 * statistics.median(times), 1),
                "p99 ms": round(1e3 * times[int(0.99 * (len(times) - 1))], 1),
            }
        )
    return rows


def twice(objects: Objects, id: str) -> dict[str, Any]:
    """Composites with a cache for half a matte, and what it holds."""
    matte, whole = Matte(objects, id), Cache(objects, 1 << 34)
    backdrop = Backdrop(np.ones((8, 8, 3), np.float32))
    light = node_light(backdrop, matte.columns, matte.rows, CORES)

    def run(cache: Cache) -> float:
        return best(
            lambda: compose(matte, light, Window.of(matte), partial(cache.strip, id), CORES),
            rounds=3,
        )

    kept = run(whole)
    half = Cache(objects, whole.bytes // 2)
    before = psutil.Process().memory_info().rss
    read = run(half)
    return {
        "bytes of the matte": whole.bytes,
        "kept, ms": round(kept, 1),
        "half kept, ms": round(read, 1),
        "bytes held": half.bytes,
        "more memory, MB": round((psutil.Process().memory_info().rss - before) / 1e6),
    }


def first(client: Client, matte: str) -> float:
    """Milliseconds of the first composite of a freshly started service."""
    start = time.perf_counter()
    client.composite(matte, backdrops(1)[0], kind="image/jpeg")
    return round(1e3 * (time.perf_counter() - start), 1)


if __name__ == "__main__":
    main()
