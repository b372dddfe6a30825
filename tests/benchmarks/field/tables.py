"""The tables in Markdown of what was measured."""

from collections.abc import Iterator
from typing import Any

import numpy as np

TRACED = {"dB": 1, "fine checker": 1, "s / 1,000": 2, "kB / 1,000": 0}
"""Decimals of the means over traced scenes that a table shows."""
TAKEN = {"dB": 1, "worst": 1, "s / 1,000": 2}
"""Those over photographs."""


def report(rows: list[dict[str, Any]]) -> Iterator[str]:
    """A table for each camera, and one of the means over the traced scenes by camera."""
    by_camera = {
        camera: [row for row in rows if row["camera"] == camera]
        for camera in dict.fromkeys(row["camera"] for row in rows)
    }
    for camera, of in by_camera.items():
        yield from ["", camera, "", *table(of, TAKEN if camera == "photographs" else TRACED)]
    by_camera.pop("photographs", None)
    if len(by_camera) > 1:
        means = [{"scene": camera} | mean for camera, of in by_camera.items() for mean in averaged(of)]
        yield from ["", "means over the scenes", "", *table(means, {"dB": 1})]


def averaged(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The mean frames and dB of each method over the scenes of a camera."""
    found = []
    for method in dict.fromkeys(row["method"] for row in rows):
        of = [row for row in rows if row["method"] == method]
        mean = {name: float(np.mean([row[name] for row in of])) for name in ("frames", "dB")}
        found.append({"method": method} | mean)
    return found


def table(rows: list[dict[str, Any]], figures: dict[str, int]) -> list[str]:
    """A table in Markdown: a row for each method, best first, a column for each scene, and means over the scenes.

    Methods that were not run on all scenes come last, and have no mean.

    Parameters
    ----------
    rows : list of dict
        Of one camera.
    figures : dict of int
        The decimals of each figure; the first is that of the scenes, whose mean is called so.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    first, *others = figures
    lines = []
    for name in dict.fromkeys(row["method"] for row in rows):
        of = {row["scene"]: row for row in rows if row["method"] == name}
        complete = len(of) == len(scenes)
        mean = {key: float(np.mean([row[key] for row in of.values()])) for key in ("frames", *figures)}
        cells = [name, f"{mean['frames']:.0f}"]
        cells += [f"{of[scene][first]:.1f}" if scene in of else "" for scene in scenes]
        cells += [f"{mean[key]:,.{decimals}f}" if complete else "" for key, decimals in figures.items()]
        lines.append((complete, mean[first], f"| {' | '.join(cells)} |"))
    columns = ["method", "frames", *scenes, "mean", *others]
    head = [f"| {' | '.join(columns)} |", f"|---|{'---:|' * (len(columns) - 1)}"]
    return head + [line for *_, line in sorted(lines, reverse=True)]
