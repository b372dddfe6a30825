"""Reruns the paper's own comparisons on traced scenes, and sets its method beside others.

    python tests/benchmarks/recovery/paper.py KIT SCENES [--pixels N] [--json FILE]

KIT is the path of a `kit.py` that films scenes and scores composites, SCENES a folder of its scenes (`*.npz`). The
recovery functions run on a pseudo-random sample of each object's pixels, always the same, filmed in memory with
8 levels and the bands 16x12:24,128x96:N at 8 bits; composites over the kit's backdrops are scored against the truth.

1. Fig. 4 and 5: with and without the Gaussian prior at 100 to 400 fine images, the channels apart.
2. Table 2: hierarchical and direct, at 400 images.
3. Methods at equal frames, libraries' own solvers among them. The rivals get the measurements of each channel in the
   +-1 form and go from level to level as NN-DGSR does, or solve directly for all cells (`solvers`).

Times are of one core, errors the mean over the backdrops. "grid" is what the true T on the same grid scores.
Rivals need scikit-learn (``pip install envmatte[bench]``).
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from kits import load, parser_of
from numpy.typing import NDArray
from solvers import Recover, lasso, least_squares, pursuit, rival

from workflows.images.resample import area_mean
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry, estimate_noise, fit_photometry
from workflows.recovery.dgsr import recover as dgsr
from workflows.recovery.dgsr.options import DgsrOptions
from workflows.recovery.lobes import recover as lobes
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.sensing import Patterns, Sensing
from workflows.recovery.transport import Transport

LEVELS, SEED, NOISE, DEPTH = 8, 7, 1.0, 8
COARSE, FINE = (16, 12, 24), (128, 96)
IMAGES = (100, 200, 300, 400)
FRAMES = (132, 282)


@dataclass
class Take:
    """Filmed pixels of a scene, as a recovery gets them, and the scene to score composites by."""

    scene: Any
    light: PatternLight
    photometry: Photometry
    sensing: Sensing
    noise: NoiseModel
    program: Program


def sample(kit: ModuleType, path: Path, count: int) -> Any:
    """A scene of only `count` pixels of the object."""
    whole = kit.Scene.load(path)
    pixels = np.flatnonzero(whole.object_pixels)
    chosen = np.sort(np.random.default_rng(0).permutation(pixels)[:count])
    transport = [channel[chosen] for channel in whole.transport]
    return kit.Scene((len(chosen), 1), whole.monitor, transport, whole.coverage.reshape(1, -1)[:, chosen])


def film(kit: ModuleType, scene: Any, bands: list[tuple[int, int, int]]) -> Take:
    """Film a program of the given bands."""
    described = kit.program_of(scene, LEVELS, bands, SEED, False)
    rng = np.random.default_rng(SEED)
    frames = [kit.sensor(light, rng, NOISE, "linear", DEPTH)[0] for light in kit.light(scene, described)]
    codes = np.stack(frames, axis=1)
    top = np.iinfo(codes.dtype).max
    every = PatternLight.of(codes.astype(np.float32) / np.float32(top), (codes > 0) & (codes < top))
    program = Program.model_validate(described)
    numbers, levels = program.constants
    constant = every.of_patterns(numbers)
    noise = estimate_noise(constant.values, levels, constant.usable, 1 / top)
    photometry = fit_photometry(constant, levels, noise)
    light = PatternLight.of(every.values[:, program.measured])  # the solvers leave nothing out
    return Take(scene, light, photometry, program.sensing("linear"), noise, program)


def measure(kit: ModuleType, take: Take, recover: Recover) -> dict[str, float]:
    """Recover, composite over every backdrop, score."""
    start = time.process_time()
    T = recover(take.light, take.photometry, take.sensing, take.noise)
    seconds = time.process_time() - start
    errors = _errors(
        kit,
        take.scene,
        lambda light: take.photometry.S + take.photometry.rho * T.apply(light),
        T.columns,
        T.rows,
    )
    return errors | {"seconds": seconds / len(take.light.values) * 1000}


def grid_errors(kit: ModuleType, scene: Any) -> dict[str, float]:
    """Score of the true T on the finest grid."""
    blocks = scene.blocks(*FINE)
    return _errors(
        kit,
        scene,
        lambda light: (
            0.02
            + 0.9 * np.stack([block @ light[: block.shape[1], c] for c, block in enumerate(blocks)], axis=-1)
        ),
        *FINE,
    )


def _errors(
    kit: ModuleType,
    scene: Any,
    composite: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    columns: int,
    rows: int,
) -> dict[str, float]:
    """Mean squared error and mean PSNR over the backdrops."""
    scores = []
    for backdrop in _backdrops(kit):
        light = Pyramid.over(columns, rows).light(area_mean(backdrop, columns, rows))
        scores.append(kit.score(scene, backdrop, composite(light)[np.newaxis]))
    return {"mse": float(np.mean(10 ** (-np.array(scores) / 10))), "psnr": float(np.mean(scores))}


@cache
def _backdrops(kit: ModuleType) -> list[NDArray[np.float32]]:
    return list(kit.backdrops().values())


def figures_4_and_5(kit: ModuleType, scenes: dict[str, Any]) -> list[dict[str, Any]]:
    """With and without the Gaussian prior."""
    rows = []
    for images in IMAGES:
        of_images = []
        for name, scene in scenes.items():
            take = film(kit, scene, [COARSE, (*FINE, images)])
            plain = measure(kit, take, partial(dgsr.recover, options=DgsrOptions(prior="none")))
            filtered = measure(kit, take, dgsr.recover)
            of_images.append({"grid": grid_errors(kit, scene), "none": plain, "gaussian": filtered})
            rows.append({"images": images, "scene": name} | _compared(of_images[-1:]))
        rows.append({"images": images, "scene": "all"} | _compared(of_images))
    return rows


def _compared(found: list[dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Means over scenes, and by how much the prior reduces the squared error: in all, and above that of the grid."""
    grid, plain, filtered = (
        float(np.mean([f[kind]["mse"] for f in found])) for kind in ("grid", "none", "gaussian")
    )
    return {
        "grid mse": grid,
        "none mse": plain,
        "gaussian mse": filtered,
        "less %": 100 * (1 - filtered / plain),
        "less above grid %": 100 * (1 - (filtered - grid) / (plain - grid)),
        "grid psnr": float(np.mean([f["grid"]["psnr"] for f in found])),
        "none psnr": float(np.mean([f["none"]["psnr"] for f in found])),
        "gaussian psnr": float(np.mean([f["gaussian"]["psnr"] for f in found])),
    }


def table_2(kit: ModuleType, scenes: dict[str, Any]) -> list[dict[str, Any]]:
    """Hierarchical and direct."""
    takes = {name: film(kit, scene, [COARSE, (*FINE, IMAGES[-1])]) for name, scene in scenes.items()}
    rows = []
    for prior in ("none", "gaussian"):
        for name, take in takes.items():
            row: dict[str, Any] = {"prior": prior, "scene": name}
            for levels in ("hierarchical", "direct"):
                recover = partial(dgsr.recover, options=DgsrOptions(prior, levels))  # type: ignore[arg-type]
                found = measure(kit, take, recover)
                row |= {f"{levels} s / 1,000": found["seconds"], f"{levels} mse": found["mse"]}
            rows.append(row)
    return rows


def _lobes(
    patterns: Patterns,
    light: PatternLight,
    photometry: Photometry,
    sensing: Sensing,
    noise: NoiseModel,
) -> Transport:
    return lobes.recover(light, photometry, patterns, noise).transport


def methods(kit: ModuleType, scenes: dict[str, Any]) -> list[dict[str, Any]]:
    """All methods on the same frames."""
    runs: dict[str, tuple[str, Recover]] = {
        "nn-dgsr, no prior, apart": (
            "hierarchical",
            partial(dgsr.recover, options=DgsrOptions(prior="none")),
        ),
        "nn-dgsr, no prior, joint": (
            "hierarchical",
            partial(dgsr.recover, options=DgsrOptions(prior="none", channels="joint")),
        ),
        "nn-dgsr, gaussian, apart": ("hierarchical", dgsr.recover),
        "nn-dgsr, gaussian, joint": (
            "hierarchical",
            partial(dgsr.recover, options=DgsrOptions(channels="joint")),
        ),
        "matching pursuit (scikit-learn)": ("hierarchical", rival(pursuit, "hierarchical")),
        "matching pursuit (scikit-learn) ": ("direct", rival(pursuit, "direct")),
        "non-negative lasso (scikit-learn)": ("hierarchical", rival(lasso, "hierarchical")),
        "non-negative least squares (scipy)": ("hierarchical", rival(least_squares, "hierarchical")),
    }
    rows = []
    for frames in FRAMES:
        bands = [COARSE, (*FINE, frames - LEVELS - COARSE[2])]
        takes = {name: film(kit, scene, bands) for name, scene in scenes.items()}
        patterns = lay_out(next(iter(takes.values())).program, "linear")
        own = partial(_lobes, patterns)
        for name, (levels, recover) in ({"lobes": ("the monitor's pixels", own)} | runs).items():
            found = {scene: measure(kit, take, recover) for scene, take in takes.items()}
            row: dict[str, Any] = {"frames": frames, "method": name.strip(), "levels": levels}
            row |= {f"{scene} psnr": figures["psnr"] for scene, figures in found.items()}
            row["mean psnr"] = float(np.mean([figures["psnr"] for figures in found.values()]))
            row["mean mse"] = float(np.mean([figures["mse"] for figures in found.values()]))
            row["s / 1,000"] = float(np.mean([figures["seconds"] for figures in found.values()]))
            rows.append(row)
    return rows


def show(title: str, rows: list[dict[str, Any]]) -> None:
    """Print a table; squared errors in units of 1e-4."""

    def text(name: str, value: Any) -> str:
        if isinstance(value, float):
            return f"{value * 1e4:.3f}" if name.endswith("mse") else f"{value:.2f}"
        return str(value)

    cells = [[f"{name} e-4" if name.endswith("mse") else name for name in rows[0]]]
    cells += [[text(name, value) for name, value in row.items()] for row in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(rows[0]))]
    print(f"\n{title}")
    for row in cells:
        print("  ".join(value.rjust(width) for value, width in zip(row, widths, strict=True)), flush=True)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--pixels", type=int, default=150, help="pixels of each scene; table 2 takes a tenth")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    kit = load(args.kit)
    scenes = {path.stem: sample(kit, path, args.pixels) for path in sorted(args.scenes.glob("*.npz"))}
    few = {
        path.stem: sample(kit, path, max(args.pixels // 10, 1)) for path in sorted(args.scenes.glob("*.npz"))
    }
    # Compile before the clock starts.
    take = film(kit, next(iter(few.values())), [COARSE, (*FINE, 20)])
    dgsr.recover(take.light, take.photometry, take.sensing, take.noise)
    measure(kit, take, partial(_lobes, lay_out(take.program, "linear")))
    tables = {}
    for name, title, run, of in (
        ("figures 4 and 5", "Fig. 4 and 5: the Gaussian prior, channels apart", figures_4_and_5, scenes),
        ("table 2", f"Table 2: hierarchical and direct, {IMAGES[-1]} images, channels apart", table_2, few),
        ("methods", "Methods at equal frames, on 128 x 96 cells", methods, scenes),
    ):
        tables[name] = run(kit, of)
        show(title, tables[name])
    if args.json:
        args.json.write_text(json.dumps(tables, indent=2))


if __name__ == "__main__":
    main()
