"""Measures how long it takes until a film is ready, step by step.

    python -m tests.benchmarks.ingest.films FOLDER [--size 1920x1080] [--fps 60] [--megabits 24] [--workers 2]
        [--json FILE]

The film is kept in FOLDER: the default program in its border, which fills the picture, with noise, in H.264. Prints the
film's seconds and megabytes; the seconds until its capture is ready after its last byte, and of the steps: finding the
patterns, averaging their frames (of all workers together), measuring and trying out; and the megabytes of the largest
worker.
"""

import argparse
import json
import sqlite3
import tempfile
import time
import zipfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import psutil
from av.video.reformatter import ColorRange
from numpy.typing import NDArray

from services.cli.demo_run import service
from services.client import Client
from storage.steps import FINISH, PREPARE
from tests.benchmarks.recovery.kits import show
from workflows.programs.files import fit_to_screen
from workflows.programs.video import write_video

RATE = 2.0
"""Patterns a second."""
GAIN, OFFSET, NOISE = 0.85, 12.0, 2.0
"""Of the camera, in codes of 8 bits."""
FIELDS = 6
"""Pictures of noise that follow each other."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", default="1920x1080", metavar="WIDTHxHEIGHT")
    parser.add_argument("--fps", type=int, default=60)
    parser.add_argument("--megabits", type=float, default=24.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    archive = args.folder / f"film-{args.size}-{args.fps}.zip"
    if not archive.exists():
        width, height = map(int, args.size.split("x"))
        make_film(archive, (width, height), args.fps, args.megabits)
    row = measure(archive, args.workers)
    print("  ".join(f"{name:>8}" for name in row))
    show(row)
    if args.json:
        args.json.write_text(json.dumps(row, indent=2))


def make_film(archive: Path, size: tuple[int, int], fps: int, megabits: float) -> None:
    """Film the video of the default program, as a camera would that sees nothing but the display."""
    with tempfile.TemporaryDirectory(dir=archive.parent) as name:
        shown, filmed, part = Path(name, "shown.mp4"), Path(name, "film.mp4"), Path(name, "part.zip")
        write_video(fit_to_screen("default", size, bordered=True), shown, RATE, lambda done, of: None)
        with av.open(str(filmed), "w") as target:
            # A key frame each second, as in films of phones: a slab is decoded from the last one before it.
            options = {"preset": "ultrafast", "g": str(fps)}
            stream = target.add_stream("libx264", rate=fps, options=options)
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            stream.bit_rate = round(megabits * 1e6)
            for number, picture in enumerate(seen(shown, fps)):
                frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
                frame.pts, frame.time_base = number, Fraction(1, fps)
                target.mux(stream.encode(frame))
            target.mux(stream.encode())
        with zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as file:
            file.write(shown.with_suffix(".json"), "capture.json")
            file.write(filmed, "film.mp4")
        part.replace(archive)


def seen(shown: Path, fps: int) -> Iterator[NDArray[np.uint8]]:
    """The frames of a camera, (height * 3 / 2, width) uint8: luma, and below it the colours."""
    rng = np.random.default_rng(0)
    with av.open(str(shown)) as video:
        stream = video.streams.video[0]
        number, noise = 0, np.zeros((FIELDS, stream.height, stream.width), np.float32)
        noise[:] = rng.normal(0, NOISE, noise.shape)
        for frame in video.decode(stream):
            narrow = frame.reformat(format="yuv420p", dst_color_range=ColorRange.MPEG)  # as cameras record
            picture = np.asarray(narrow.to_ndarray(), np.uint8)
            assert frame.time is not None
            until = frame.time + float(1 / (stream.average_rate or 1))
            while number / fps < until:
                luma = GAIN * picture[: stream.height] + OFFSET + noise[number % FIELDS]
                colours = GAIN * (picture[stream.height :] - 128.0) + 128
                yield np.clip(np.concatenate([luma, colours]), 0, 255).astype(np.uint8)
                number += 1


def measure(archive: Path, workers: int) -> dict[str, Any]:
    """Upload a film, and wait until its capture is ready."""
    with tempfile.TemporaryDirectory() as folder, service(Path(folder, "data"), workers) as url:
        with Client(url) as client:
            capture = client.upload(archive)
            start, largest = time.perf_counter(), 0

            def watch(job: object) -> None:
                nonlocal largest
                largest = max(largest, *(memory_of(process) for process in psutil.Process().children(True)))

            ended = client.wait(capture, progress=watch).answer
            seconds = time.perf_counter() - start
        with sqlite3.connect(Path(folder, "data", "envmatte.db")) as ledger:
            query = "select tile, seconds from tiles where job = ?"
            took = dict(ledger.execute(query, (ended["id"],)).fetchall())
    with zipfile.ZipFile(archive) as file, file.open("film.mp4") as film, av.open(film, "r") as video:
        length = (video.duration or 0) / av.time_base
    return {
        "film_s": round(length),
        "film_MB": round(archive.stat().st_size / 1e6),
        "ready_s": round(seconds, 1),
        "find_s": round(took.pop(PREPARE), 1),
        "try_out_s": round(took.pop(FINISH), 1),
        "average_s": round(sum(took.values()), 1),
        "worker_MB": round(largest / 1e6),
    }


def memory_of(process: psutil.Process) -> int:
    """The bytes of a worker process, 0 of others."""
    try:
        forked = "multiprocessing.forkserver" in " ".join(process.cmdline())
        return int(process.memory_info().rss) if forked else 0
    except psutil.NoSuchProcess:
        return 0


if __name__ == "__main__":
    main()
