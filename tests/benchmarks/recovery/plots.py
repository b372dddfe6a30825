"""Plots the time of a recovery and the calibration of its confidence on traced scenes.

    python tests/benchmarks/recovery/plots.py KIT SCENES FOLDER [--pixels 2000]

KIT is the path of a `kit.py` that films scenes, SCENES a folder of its scenes (`*.npz`). Writes to FOLDER

- `speed.png`: seconds against pixels, and seconds for 1,000 pixels against frames, of one core, without compiling;
- `confidence.png`: the share of the squared error in composites that the pixels of least confidence hold, and at best
  could;
- `plots.json`: the figures behind them.

Needs matplotlib (``pip install envmatte[bench]``).
"""

import json
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib
import numpy as np
from kits import load, parser_of
from numpy.typing import NDArray
from paper import sample
from scipy.stats import spearmanr

from workflows.images.resample import area_mean
from workflows.programs.parts import Bernoulli
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import estimate_noise, fit_photometry
from workflows.recovery.lobes import recover as lobes

matplotlib.use("Agg")
from matplotlib import pyplot

PIXELS = (250, 500, 1000, 2000)
TIMES = (0.25, 0.5, 1, 2, 4)


class Filmed:
    """A scene filmed with a program, and its recovery."""

    def __init__(self, kit: ModuleType, scene: Any, program: Program) -> None:
        self.kit, self.scene, self.program = kit, scene, program
        rng = np.random.default_rng(7)
        frames = [
            kit.sensor(
                scene.composite(np.broadcast_to(picture, (*picture.shape[:2], 3)))[0], rng, 1.0, "linear", 8
            )
            for picture in program.pictures(0, program.count)
        ]
        codes = np.stack(frames, axis=1)
        self.light = PatternLight.of(codes.astype(np.float32) / 255, (codes > 0) & (codes < 255))
        self.numbers, self.sent = program.constants
        constant = self.light.of_patterns(self.numbers)
        self.noise = estimate_noise(constant.values, self.sent, constant.usable, 1 / 255)
        self.patterns = lay_out(program, "linear")

    def recover(self, pixels: int) -> tuple[lobes.Recovery, float]:
        """Recover the first pixels; also returns the seconds it took."""
        light = self.light.of_pixels(slice(pixels))
        photometry = fit_photometry(light.of_patterns(self.numbers), self.sent, self.noise)
        start = time.process_time()
        shown = light.of_patterns(self.program.measured)
        found = lobes.recover(shown, photometry, self.patterns, self.noise)
        return found, time.process_time() - start

    def errors(self, found: lobes.Recovery) -> NDArray[np.float64]:
        """Mean squared error of each pixel over the kit's backdrops."""
        squares = []
        for backdrop in self.kit.backdrops().values():
            light = self.patterns.pyramid.light(area_mean(backdrop, *self.patterns.pyramid.grids[0]))
            composite = found.photometry.S + found.photometry.rho * found.transport.apply(light)
            truth = 0.02 + 0.9 * self.scene.composite(backdrop)[0]
            squares.append(((composite - truth) ** 2).mean(axis=1))
        mean: NDArray[np.float64] = np.mean(squares, axis=0)
        return mean


def scaled(factor: float) -> Program:
    """The default preset with other numbers of random patterns."""
    made = preset("default")
    parts = [
        part.model_copy(update={"count": max(round(part.count * factor), 1)})
        if isinstance(part, Bernoulli)
        else part
        for part in made.parts
    ]
    return Program(monitor=made.monitor, parts=tuple(parts))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pixels", type=int, default=max(PIXELS))
    args = parser.parse_args()
    kit = load(args.kit)
    paths = sorted(args.scenes.glob("*.npz"))
    args.folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"pixels": {}, "frames": {}, "confidence": {}}

    trust, axes = pyplot.subplots(1, len(paths), figsize=(4 * len(paths), 4), layout="constrained")
    for path, axis in zip(paths, np.atleast_1d(axes), strict=True):
        filmed = Filmed(kit, sample(kit, path, args.pixels), preset("default"))
        filmed.recover(1)  # compiles
        figures["pixels"][path.stem] = {n: filmed.recover(n)[1] for n in PIXELS if n <= args.pixels}
        found, _ = filmed.recover(args.pixels)
        error = filmed.errors(found)
        share = np.arange(1, error.size + 1) / error.size
        held, best = (
            np.cumsum(error[np.argsort(-by, kind="stable")]) / error.sum() for by in (found.error, error)
        )
        rank = float(spearmanr(found.error, error).statistic)
        worst = -(error.size // -20)
        figures["confidence"][path.stem] = {
            "rank": rank,
            "worst_5_hold": float(held[worst]),
            "at_best": float(best[worst]),
        }
        axis.plot(share, held, label="least confidence first")
        axis.plot(share, best, ":", label="largest error first")
        axis.axvline(0.05, color="grey", linewidth=0.5)
        axis.set(title=f"{path.stem}: rank correlation {rank:.2f}", xlabel="share of pixels")
        axis.legend()
    np.atleast_1d(axes)[0].set_ylabel("share of squared error")
    trust.savefig(args.folder / "confidence.png", dpi=100)

    count = min(500, args.pixels)
    for path in paths:
        of_scene = figures["frames"][path.stem] = {}
        scene = sample(kit, path, count)
        for factor in TIMES:
            filmed = Filmed(kit, scene, scaled(factor))
            filmed.recover(1)
            of_scene[filmed.program.count] = filmed.recover(count)[1] / count * 1000

    speed, (by_pixels, by_frames) = pyplot.subplots(1, 2, figsize=(9, 4), layout="constrained")
    for axis, name in ((by_pixels, "pixels"), (by_frames, "frames")):
        for scene_name, points in figures[name].items():
            axis.plot(list(points), list(points.values()), "o-", label=scene_name)
        axis.set(xlabel=name, xlim=(0, None), ylim=(0, None))
        axis.legend()
    by_pixels.set_ylabel("seconds, 140 frames")
    by_frames.set_ylabel("seconds for 1,000 pixels")
    speed.savefig(args.folder / "speed.png", dpi=100)
    (args.folder / "plots.json").write_text(json.dumps(figures, indent=2))
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
