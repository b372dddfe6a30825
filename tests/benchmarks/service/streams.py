"""What event streams cost a service: `python -m tests.benchmarks.service.streams [--json FILE]`.

Follows queued jobs by 200 event streams, all of them the same job or each its own, and prints which share of a core the
service takes meanwhile, and how long a list takes to be answered. Run it from the root of the repository.
"""

import argparse
import json
import socket
import statistics
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import psutil

from tests.end_to_end.conftest import Service, serving
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

STREAMS = 200
SECONDS = 10.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = []
    with (
        tempfile.TemporaryDirectory() as folder,
        serving(Path(folder, "data"), ENVMATTE_COORDINATE="false") as service,
    ):
        archive = Path(folder, "capture.zip")
        monitor = 256, 192
        write_capture(glass_ball(16, 12, monitor=monitor, rays=4), preset("sketch", *monitor), archive)
        capture = service.client.upload(archive)["id"]
        jobs = [service.client.recover(capture)["id"] for _ in range(STREAMS)]
        print("  jobs  share of a core  a list, ms: median    max", flush=True)
        for count in (0, 1, STREAMS):
            share, times = _follow(service, jobs[:count])
            median, most = 1000 * statistics.median(times), 1000 * max(times)
            print(f"{count:6} {share:16.3f} {median:19.0f} {most:6.0f}", flush=True)
            found.append({"jobs": count, "share": share, "median_ms": median, "max_ms": most})
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))


def _follow(service: Service, jobs: list[str]) -> tuple[float, list[float]]:
    """The share of a core that streams of jobs take, `STREAMS` in all, and the seconds of other requests meanwhile."""
    at = urlsplit(service.url)
    process = psutil.Process(service.process.pid)
    with ExitStack() as stack:
        for number in range(STREAMS if jobs else 0):
            one = stack.enter_context(socket.create_connection((at.hostname, at.port), 60))
            path = f"/v1/jobs/{jobs[number % len(jobs)]}/events"
            one.sendall(f"GET {path} HTTP/1.1\r\nHost: {at.netloc}\r\n\r\n".encode())
            assert b" 200 " in one.recv(100)
        began, used, times = time.monotonic(), sum(process.cpu_times()[:2]), []
        while time.monotonic() < began + SECONDS:
            asked = time.monotonic()
            assert service.http.get("/v1/captures").status_code == 200
            times.append(time.monotonic() - asked)
            time.sleep(0.5)
        return (sum(process.cpu_times()[:2]) - used) / (time.monotonic() - began), times


if __name__ == "__main__":
    main()
