"""Recovers captures of traced scenes through the service, and scores the composites against the truth.

    python -m tests.benchmarks.recovery.figures KIT SCENES [--case default] [--film="--noise 4"] [--workers 1]
        [--json FILE]

KIT is the path of a `kit.py` that makes captures of scenes and scores composites, SCENES a folder of its scenes
(`*.npz`). For each case and scene it films the case's program with a mask, uploads the capture, recovers its matte,
requests composites over the kit's backdrops, and prints the PSNR over the object's pixels, the share of the squared
error in the 5 % of least confidence (and in the worst 5 %, the most there can be), the rank correlation of confidence
and error, the share of the pixels and channels whose 90 % interval holds the truth, before all backdrops and the least
before one, and the seconds of work for 1,000 pixels. Options in `--film` go to the kit's `capture`.
"""

import json
import shlex
import sqlite3
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from services.client import Client, ServiceError
from tests.benchmarks.recovery.kits import load, parser_of, served, show
from workflows.images import float_formats, integer_formats
from workflows.programs.files import write_folder
from workflows.programs.parts import Constant, Monitor
from workflows.programs.presets import BLACK, BLUE, GREEN, RED, WHITE, Recipe, preset, stripes_and_grids
from workflows.programs.program import Program


class Case(NamedTuple):
    """A program, or the kit's bands, and the options of recovery."""

    program: Program | str
    options: dict[str, Any]


def few(constant: tuple[tuple[float, float, float], ...], grids: dict[int, int]) -> Program:
    """These constant colours, stripes and grids in colour, for linear cameras; `grids` is as in a `Recipe`."""
    stripes, random = stripes_and_grids(Recipe(grids, "rgb", stripes=3), 1280, 960)
    return Program(
        monitor=Monitor(width=1280, height=960, response="linear"),
        parts=(Constant(kind="constant", colours=constant), *stripes, *random),
    )


NESTED = "16x12:24,32x24:20,64x48:20,128x96:20,256x192:20,512x384:20"
CASES = {
    "default": Case(preset("default"), {}),
    "fast": Case(preset("default"), {"quality": "fast"}),
    "quick": Case(preset("quick"), {}),
    "sketch": Case(preset("sketch"), {}),
    "32-frames": Case(
        few((WHITE, RED, GREEN, BLUE, BLACK), {6: 2, 12: 3, 24: 4, 48: 3, 96: 3, 192: 3, 384: 3}), {}
    ),
    "32-frames-alike": Case(few((WHITE, BLACK), {6: 3, 12: 5, 24: 4, 48: 4, 96: 4, 192: 2, 384: 2}), {}),
    "16-frames-alike": Case(few((WHITE, BLACK), {12: 2, 24: 2, 48: 2, 96: 1, 192: 1}), {}),
    "nested": Case(NESTED, {}),
    "nn-dgsr": Case("16x12:24,128x96:250", {"method": "nn-dgsr"}),
}


def measure(
    kit: ModuleType, scene: Path, name: str, film: list[str], client: Client, folder: Path
) -> dict[str, Any]:
    """Film, upload, recover, composite, score a case."""
    case = CASES[name]
    capture_archive = folder / "capture.zip"
    if isinstance(case.program, str):
        program = ["--bands", case.program]
    else:
        patterns = folder / name
        if not patterns.exists():
            write_folder(case.program, patterns, lambda *_: None)
        program = ["--program", str(patterns)]
    with redirect_stdout(None):
        kit.main(["capture", str(scene), str(capture_archive), *program, "--mask", *film])
    uploaded = client.upload(capture_archive, name=scene.stem)
    job = client.wait(client.recover(uploaded["id"], **case.options)["id"])
    with sqlite3.connect(folder / "data" / "envmatte.db") as ledger:
        (seconds,) = ledger.execute("select sum(seconds) from tiles where job = ?", (job["id"],)).fetchone()
    truth = kit.Scene.load(scene)
    crosstalk = float(film[film.index("--crosstalk") + 1]) if "--crosstalk" in film else 0.0
    scores, squares, held = {}, [], []
    for shown, backdrop in kit.backdrops().items():
        # 16 bits, so that the matte is scored and not the rounding of the response.
        sent = integer_formats.to_integers(backdrop, np.dtype(np.uint16))
        answer = client.composite(job["matte"], integer_formats.encode_png(sent), transfer="linear")
        pixels = integer_formats.to_unit(integer_formats.decode(answer, memory=1 << 28))
        scores[shown] = kit.score(truth, integer_formats.to_unit(sent), pixels[..., :3], crosstalk=crosstalk)
        mix = (1 - 3 * crosstalk) * np.eye(3) + crosstalk
        true = 0.02 + 0.9 * truth.composite(integer_formats.to_unit(sent)) @ mix
        error = (pixels[..., :3] - true)[truth.object_pixels]
        squares.append((error**2).mean(axis=1))
        held.append(within(client, job["matte"], sent, truth.object_pixels, error))
    error = np.mean(squares, axis=0)
    doubt = -integer_formats.to_unit(
        integer_formats.decode(client.layer(job["matte"], "confidence.png"), memory=1 << 28)
    )[truth.object_pixels, 0]
    worst = -(len(error) // -20)
    return {
        "case": name,
        "scene": scene.stem,
        "frames": uploaded["frames"],
        "pixels": job["pixels"],
        **{shown: round(score, 2) for shown, score in scores.items()},
        "mean": round(sum(scores.values()) / len(scores), 2),
        "worst_5_hold": share(error, doubt, worst),
        "at_best": share(error, error, worst),
        "held": round(float(np.mean(held)), 3),
        "held_least": round(float(np.min(held)), 3),
        "rank": round(float(spearmanr(doubt, error).statistic), 2),
        "seconds_per_1000_pixels": round(seconds / job["pixels"] * 1000, 2),
        "run_seconds": round(job["run_seconds"], 1),
    }


def within(
    client: Client,
    matte: str,
    backdrop: NDArray[np.uint16],
    seen: NDArray[np.bool_],
    error: NDArray[np.floating],
) -> float:
    """The share of the errors that lie within the intervals of a composite; NaN if the matte has none."""
    try:
        answer = client.composite(
            matte, integer_formats.encode_png(backdrop), kind="image/x-exr", transfer="linear", interval=True
        )
    except ServiceError:
        return float("nan")
    half = float_formats.decode(answer, memory=1 << 28)[..., :3][seen]
    return float(np.mean(np.abs(error) <= half))


def share(error: NDArray[np.floating], doubt: NDArray[np.floating], worst: int) -> float:
    """The share of the squared error that the most doubtful pixels hold."""
    return round(float(error[np.argsort(-doubt, kind="stable")[:worst]].sum() / error.sum()), 2)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--case", choices=CASES, action="append")
    parser.add_argument("--film", default="", help="Options of the kit's capture.")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    kit = load(args.kit)
    rows: list[dict[str, Any]] = []
    with served(args.workers) as (client, folder):
        for case in args.case or CASES:
            found = []
            for scene in sorted(args.scenes.glob("*.npz")):
                found.append(measure(kit, scene, case, shlex.split(args.film), client, folder))
                if not rows and len(found) == 1:
                    print("  ".join(f"{name:>8}" for name in found[0]))
                show(found[-1])
            rows += found
            means = {
                name: round(float(np.mean([row[name] for row in found])), 2) for name in list(found[0])[4:]
            }
            show({"case": case, "scene": "mean", "frames": "", "pixels": "", **means})
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
