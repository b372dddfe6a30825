"""Plots of the benchmark: dB against frames and seconds, and each method's dB on each scene."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot

OURS = "envmatte"


def plot(rows: list[dict[str, Any]], folder: Path) -> None:
    """Write ``field.png`` and ``field-scenes.png`` of the methods that `__main__` ran on all scenes."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    of = {name: [row for row in rows if row["method"] == name] for name in methods}
    methods = [name for name in methods if len(of[name]) == len(scenes)]
    mean = {name: float(np.mean([row["dB"] for row in of[name]])) for name in methods}
    methods.sort(key=lambda name: -mean[name])

    figure, panels = pyplot.subplots(1, 2, figsize=(12, 6.5), sharey=True, layout="constrained")
    for panel, key, label in zip(
        panels, ("frames", "s / 1,000"), ("frames", "seconds of a core for 1,000 pixels"), strict=True
    ):
        for rank, name in enumerate(methods, 1):
            x = float(np.mean([row[key] for row in of[name]]))
            colour = "tab:red" if name.startswith(OURS) else "tab:blue"
            panel.plot(x, mean[name], "o", color=colour, label=f"{rank} {name}")
            panel.annotate(str(rank), (x, mean[name]), (4, 3), textcoords="offset points", fontsize=8)
        panel.set(xscale="log", xlabel=label)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("PSNR in dB, mean of scenes and backdrops")
    panels[1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    figure.savefig(folder / "field.png", dpi=80)

    values = np.array([[row["dB"] for row in of[name]] for name in methods])
    figure, panel = pyplot.subplots(figsize=(9, 0.32 * len(methods) + 1), layout="constrained")
    panel.imshow(values, cmap="viridis", aspect="auto", vmin=15, vmax=55)
    panel.set_xticks(range(len(scenes)), scenes)
    panel.set_yticks(range(len(methods)), methods, fontsize=8)
    for (y, x), value in np.ndenumerate(values):
        colour = "black" if value > 40 else "white"
        panel.text(x, y, f"{value:.1f}", ha="center", va="center", fontsize=8, color=colour)
    figure.savefig(folder / "field-scenes.png", dpi=80)
