"""Measures `GET /v1/jobs/{id}` under load: 50 pollers, a recovery, and one ingest after another.

    python -m tests.benchmarks.service.latency [--pollers 50] [--seconds 30] [--megapixels 2] [--json FILE]

A real service has two workers. Each poller sends a request a second over its own connection, as a waiting client does.
Prints the latency of all their requests, without other work and with more and more of it. Run it from the root of the
repository.
"""

import argparse
import asyncio
import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from services.cli.demo_run import service
from services.client import Client
from tests.benchmarks.cluster.sharing import BANDS, enlarge
from tests.benchmarks.recovery.kits import show
from tests.parts.background import repeating
from tests.parts.captures import nested_program
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture


async def poll(url: str, path: str, phase: float, until: float, took: list[float]) -> None:
    """Ask once a second."""
    at = urlsplit(url)
    reader, writer = await asyncio.open_connection(at.hostname, at.port)
    request = f"GET {path} HTTP/1.1\r\nHost: {at.netloc}\r\n\r\n".encode()
    due = time.perf_counter() + phase
    while due < until:
        await asyncio.sleep(max(due - time.perf_counter(), 0))
        start = time.perf_counter()
        writer.write(request)
        head = (await reader.readuntil(b"\r\n\r\n")).lower()
        assert head.startswith(b"http/1.1 200"), head
        await reader.readexactly(int(head.split(b"content-length:")[1].split(b"\r\n")[0]))
        took.append(time.perf_counter() - start)
        due = max(due + 1, time.perf_counter())
    writer.close()


def polled(url: str, path: str, pollers: int, seconds: float) -> dict[str, Any]:
    """Latencies of that many pollers, in milliseconds."""
    took: list[float] = []

    async def all_of_them() -> None:
        until = time.perf_counter() + seconds
        await asyncio.gather(*(poll(url, path, n / pollers, until, took) for n in range(pollers)))

    asyncio.run(all_of_them())
    p50, p90, p99, longest = np.percentile(took, [50, 90, 99, 100]) * 1e3
    return {"requests": len(took)} | {
        name: round(float(value), 1)
        for name, value in zip(
            ("p50 ms", "p90 ms", "p99 ms", "max ms"), (p50, p90, p99, longest), strict=True
        )
    }


@contextmanager
def repeated(client: Client, capture_archive: Path) -> Iterator[None]:
    """Upload and ingest a capture, and delete it, again and again."""

    def ingest() -> None:
        capture = client.upload(capture_archive)
        client.wait(capture["job"])
        client.delete(capture)

    with repeating(ingest, 0):
        yield


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pollers", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--megapixels", type=float, default=2, help="Of the captures.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []

    def measure(beside: str, path: str) -> None:
        rows.append({"beside": beside} | polled(url, path, args.pollers, args.seconds))
        show(rows[-1])

    with (
        tempfile.TemporaryDirectory() as folder,
        service(Path(folder, "data"), 2) as url,
        Client(url) as client,
    ):
        small, large = Path(folder, "small.zip"), Path(folder, "large.zip")
        write_capture(glass_ball.glass_ball(160, 120, rays=9), nested_program(bands=BANDS, levels=5), small)
        enlarge(small, large, args.megapixels)
        capture = client.upload(large)
        client.wait(capture["job"])
        measure("nothing", f"/v1/jobs/{capture['job']}")
        job = client.recover(capture)
        path = f"/v1/jobs/{job['id']}"
        while not client.job(job["id"])["tiles"]["done"]:  # its workers load code that later jobs find loaded
            time.sleep(0.1)
        measure("a recovery", path)
        with repeated(client, large):
            time.sleep(1)
            measure("a recovery, and ingests", path)
        client.cancel(job["id"])
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
