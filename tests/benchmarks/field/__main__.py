"""Runs every published method of environment matting on the same traced scenes, with the frames that each needs.

    python -m tests.benchmarks.field [--pixels N] [--only WORD ...] [--scenes NAME ...] [--json FILE] [--plots FOLDER]

For each method and scene: the frames, the mean PSNR in dB over the backdrops, that before the fine checker, the seconds
of processor time for the sampled pixels, and the kilobytes that the matte takes for each thousand of them.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.field.ours import Engine
from tests.benchmarks.field.rivals import METHODS
from tests.benchmarks.field.scenes import SCENES, film, sample, score


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.field",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--pixels", type=int, default=64, help="pixels of each scene")
    parser.add_argument("--only", nargs="*", help="methods with one of these words in their name")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plots", type=Path, help="folder for two PNG")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    few = sample(args.scenes[0], 1)
    methods = [make for make in METHODS if not args.only or any(word in make().name for word in args.only)]
    for method in (make() for make in methods):
        if isinstance(method, Engine):  # compile before the clock starts
            method.recover(film(few, method))
    for scene in args.scenes:
        taken = sample(scene, args.pixels)
        for make in methods:
            method = make()
            filmed = film(taken, method)
            start = time.process_time()
            matte = method.recover(filmed)
            seconds = time.process_time() - start
            psnr = score(taken, matte)
            thousands = len(filmed.values) / 1000
            rows.append(
                {
                    "scene": scene,
                    "method": method.name,
                    "frames": len(filmed.pictures),
                    "dB": float(np.mean(list(psnr.values()))),
                    **psnr,
                    "s / 1,000": seconds / thousands,
                    "kB / 1,000": matte.bytes / 1000 / thousands,
                }
            )
            show(rows[-1])
        if args.json:  # after each scene, so that a run that is stopped leaves what it has
            args.json.write_text(json.dumps(rows, indent=1) + "\n")
    print()
    for line in table(rows):
        print(line)
    if args.plots:
        from tests.benchmarks.field.plots import plot

        plot(rows, args.plots)


def show(row: dict[str, Any]) -> None:
    """Print what was measured as it comes."""
    print(
        f"{row['scene']:>10}  {row['method']:<28} {row['frames']:>5} frames {row['dB']:6.1f} dB"
        f" {row['fine checker']:6.1f} dB {row['s / 1,000']:8.2f} s / 1,000 {row['kB / 1,000']:8.0f} kB / 1,000",
        flush=True,
    )


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A table in Markdown: a row for each method, best first, a column for each scene, and means over the scenes.

    Methods that were not run on all scenes come last, and have no mean.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    columns = ["method", "frames", *scenes, "mean", "fine checker", "s / 1,000", "kB / 1,000"]
    lines = []
    for name in dict.fromkeys(row["method"] for row in rows):
        of = {row["scene"]: row for row in rows if row["method"] == name}
        complete = len(of) == len(scenes)
        mean = {
            key: float(np.mean([row[key] for row in of.values()]))
            for key in ("frames", "dB", "fine checker", "s / 1,000", "kB / 1,000")
        }
        cells = [name, f"{mean['frames']:.0f}"]
        cells += [f"{of[scene]['dB']:.1f}" if scene in of else "" for scene in scenes]
        cells += [f"{mean[key]:.1f}" if complete else "" for key in ("dB", "fine checker")]
        cells += [f"{mean['s / 1,000']:.2f}", f"{mean['kB / 1,000']:,.0f}"]
        lines.append((complete, mean["dB"], f"| {' | '.join(cells)} |"))
    head = [f"| {' | '.join(columns)} |", f"|---|{'---:|' * (len(columns) - 1)}"]
    return head + [line for *_, line in sorted(lines, reverse=True)]


if __name__ == "__main__":
    main()
