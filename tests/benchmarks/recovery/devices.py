"""Runs a tool that films traced scenes as real devices would, and tabulates what the service makes of them.

    python -m tests.benchmarks.recovery.devices TOOL SCENE ... [--case phone_film,raw_stills] [--rows FILE.jsonl]
        [--plot FILE.svg]

TOOL is a script whose ``run`` makes captures of scenes by devices (``--case``), lets the service at ``--url`` recover
and composite them, and appends a row of JSON for each to ``--results``: `scene`, `case`, `promised` (low and high, dB)
and `psnr` (`lin` linear, `disp` as displayed, `mat` after the best exposure, colours and gamma). Prints the mean of
each case over the scenes. Rows that the file has already are kept and not measured again. The plot, of the promised
PSNR against what was reached, needs matplotlib (``pip install envmatte[bench]``).
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from services.cli.demo_run import service

CASES = ("ideal", "raw_stills", "jpeg_stills", "ideal_film", "phone_film", "phone_film_free")
SCORES = ("lin", "disp", "mat")
WITHIN = 2.0
"""dB that the promised range may miss what is reached by."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tool")
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--case", default=",".join(CASES))
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = given.rows or Path(folder, "rows.jsonl")
        there = {(row["scene"], row["case"]) for row in read(file)}
        for scene in given.scenes:
            cases = [case for case in given.case.split(",") if (Path(scene).stem, case) not in there]
            if not cases:
                continue
            with service(Path(folder, "data"), workers=2) as url:
                words = ["run", scene, "--case", ",".join(cases), "--results", str(file), "--url", url]
                subprocess.run([sys.executable, given.tool, *words], check=True)
        rows = [row for row in read(file) if "psnr" in row]
    for line in table(rows):
        print(line)
    if given.plot:
        plot(rows, given.plot)


def read(file: Path) -> list[dict[str, Any]]:
    """The rows of a file, none if there is none."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def table(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each case: means over the scenes, and by how much the promise misses at worst."""
    lines = [f"{'case':>16} scenes {'  '.join(f'{score:>5}' for score in SCORES)}   promised      missed by"]
    for case in dict.fromkeys(row["case"] for row in rows):
        of_case = [row for row in rows if row["case"] == case]
        means = "  ".join(f"{np.mean([row['psnr'][s] for row in of_case]):5.1f}" for s in SCORES)
        promised = [row for row in of_case if row["promised"][0] is not None]
        low, high = (float(np.mean([row["promised"][end] for row in promised])) for end in (0, 1))
        missed = max((miss(row) for row in promised), key=abs)
        lines.append(f"{case:>16} {len(of_case):6} {means}   {low:4.1f} to {high:4.1f}  {missed:+6.1f} dB")
    return lines


def miss(row: dict[str, Any]) -> float:
    """dB by which what was reached is above the promised range, or below it (negative), or 0."""
    low, high = row["promised"]
    reached = float(row["psnr"]["lin"])
    return max(reached - high, 0.0) + min(reached - low, 0.0)


def plot(rows: list[dict[str, Any]], file: Path) -> None:
    """Plot the promised range of each capture against what was reached."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5.5, 4.5), layout="constrained")
    ends = np.array([14, 54])
    axes.fill_between(ends, ends - WITHIN, ends + WITHIN, color="0.92", label=f"within {WITHIN:g} dB")
    axes.plot(ends, ends, color="0.6", linewidth=0.8)
    for case in dict.fromkeys(row["case"] for row in rows):
        shown = [row for row in rows if row["case"] == case and row["promised"][0] is not None]
        reached = np.array([row["psnr"]["lin"] for row in shown])
        low, high = np.array([row["promised"] for row in shown]).T
        middle = (low + high) / 2
        axes.errorbar(reached, middle, [middle - low, high - middle], fmt="o", capsize=3, label=case)
    axes.set(xlabel="reached, dB", ylabel="promised by the report, dB", xlim=ends, ylim=ends)
    axes.legend(frameon=False, fontsize="small", loc="upper left")
    figure.savefig(file)


if __name__ == "__main__":
    main()
