"""Runs every published method of environment matting on the same scenes, with the frames that each needs.

    python -m tests.benchmarks.field [--pixels N] [--only WORD ...] [--scenes NAME ...] [--cameras NAME ...]
        [--photographs TOOL] [--json FILE] [--plots FOLDER]

For each camera, method and traced scene: the frames, the mean PSNR in dB over the backdrops, that before the fine
checker, the seconds of processor time for the sampled pixels, and the kilobytes that the matte takes for each thousand
of them. TOOL is a script with photographs of known patterns, as `tests.benchmarks.recovery.real` runs: with it, the
methods that any patterns serve are set beside each other on these, too.
"""

import argparse
import json
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.field import photographs
from tests.benchmarks.field.cameras import CAMERAS
from tests.benchmarks.field.methods.ours import Engine
from tests.benchmarks.field.methods.rivals import METHODS
from tests.benchmarks.field.scenes import SCENES, film, sample, score
from tests.benchmarks.field.tables import report


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.field",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--pixels", type=int, default=64, help="pixels of each scene")
    parser.add_argument("--only", nargs="*", help="methods with one of these words in their name")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--cameras", nargs="*", choices=CAMERAS, default=list(CAMERAS))
    parser.add_argument("--photographs", type=Path, metavar="TOOL")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plots", type=Path, help="folder for two PNG, of the camera `linear`")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    measured = traced(args.scenes, args.cameras, args.pixels, args.only)
    taken = photographs.measure(args.photographs, args.pixels) if args.photographs else ()
    for row in chain(measured, taken):
        rows.append(row)
        show(row)
        if args.json:  # after each, so that a run that is stopped leaves what it has
            args.json.write_text(json.dumps(rows, indent=1) + "\n")
    for line in report(rows):
        print(line)
    if args.plots:
        from tests.benchmarks.field.plots import plot

        plot([row for row in rows if row["camera"] == "linear"], args.plots)


def traced(
    scenes: list[str], cameras: list[str], pixels: int, only: list[str] | None
) -> Iterator[dict[str, Any]]:
    """Measure the methods on traced scenes, through each camera."""
    methods = [make for make in METHODS if not only or any(word in make().name for word in only)]
    few = sample(scenes[0], 1)
    for method in (make() for make in methods):
        if isinstance(method, Engine):  # compile before the clock starts
            method.recover(film(few, method))
    for camera in cameras:
        for scene in scenes:
            taken = sample(scene, pixels, CAMERAS[camera])
            for make in methods:
                method = make()
                filmed = film(taken, method)
                start = time.process_time()
                matte = method.recover(filmed)
                seconds = time.process_time() - start
                psnr = score(taken, matte)
                thousands = len(filmed.values) / 1000
                yield {
                    "camera": camera,
                    "scene": scene,
                    "method": method.name,
                    "frames": len(filmed.pictures),
                    "dB": float(np.mean(list(psnr.values()))),
                    **psnr,
                    "s / 1,000": seconds / thousands,
                    "kB / 1,000": matte.bytes / 1000 / thousands,
                }


def show(row: dict[str, Any]) -> None:
    """Print what was measured as it comes."""
    print(
        f"{row['camera']:>11}  {row['scene']:>10}  {row['method']:<28} {row['frames']:>5} frames {row['dB']:6.1f} dB"
        f" {row['s / 1,000']:8.2f} s / 1,000",
        flush=True,
    )


if __name__ == "__main__":
    main()
