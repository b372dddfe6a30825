"""Ingests unsynchronised videos of traced scenes, and compares the results with stills of the same program.

    python -m tests.benchmarks.recovery.videos KIT SCENES [--scene sphere] [--fps 30] [--workers 2] [--no-recovery]
        [--json FILE]

KIT is the path of a `kit.py` that films scenes, SCENES a folder of its scenes (`*.npz`). For each scene, rate and
jitter it films a video, uploads it, and prints: patterns found of those shown; frames kept that show another pattern
than they are taken for, by the kit's own timing, and frames kept that show a little of another; the seconds of the
video and of its ingest; the PSNR of composites over the object's pixels, mean of the kit's backdrops, and what it
lacks to that of a capture of stills.
"""

import json
import zipfile
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.client import Client
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.benchmarks.recovery.figures import NESTED
from tests.benchmarks.recovery.kits import load, parser_of, served, show
from workflows.images import integer_formats

LEAD, SEED = 1.0, 7
READOUT, PHASE = 0.020, 0.37  # of the kit's camera: seconds, and frames


class Case(NamedTuple):
    """Frames a second, seconds a pattern, and its jitter."""

    fps: int
    hold: float
    jitter: float


CASES = [Case(fps, 0.5, jitter) for fps in (25, 30, 60) for jitter in (0.03, 0.1)] + [Case(60, 0.1, 0.1)]


def starts(case: Case, count: int) -> NDArray[np.float64]:
    """When the kit shows each pattern and when it ends, from the same random numbers."""
    random = np.random.default_rng(SEED)
    holds = [case.hold * (1 + case.jitter * random.standard_normal()) for _ in range(count)]
    return LEAD + np.cumsum([0, *holds])


def sorted_wrongly(stack: Stack, case: Case, count: int) -> tuple[int, int]:
    """Number of frames that mostly show another pattern than assigned, and of those that show a little of one."""
    edges, patterns = starts(case, count), stack.attributes["patterns"]
    wrong = torn = 0
    for at, tick, _ in stack.shares().tolist():
        begin = round(tick * stack.attributes["video"]["tick"] * case.fps) / case.fps + PHASE / case.fps
        end = begin + READOUT + 0.5 / case.fps
        first, last = edges[patterns[at]], edges[patterns[at] + 1]
        wrong += not first <= (begin + end) / 2 <= last
        torn += begin < first or end > last
    return int(wrong), int(torn)


def psnr(kit: ModuleType, truth: Any, client: Client, capture: str) -> float:
    """The mean over the kit's backdrops."""
    job = client.wait(client.recover(capture)["id"])
    scores = []
    for backdrop in kit.backdrops().values():
        sent = integer_formats.to_integers(backdrop, np.dtype(np.uint16))
        answer = client.composite(job["matte"], integer_formats.encode_png(sent), transfer="linear")
        pixels = integer_formats.to_unit(integer_formats.decode(answer, memory=1 << 28))
        scores.append(kit.score(truth, integer_formats.to_unit(sent), pixels[..., :3]))
    return float(np.mean(scores))


def measure(
    kit: ModuleType, scene: Path, case: Case, client: Client, folder: Path, stills: float | None
) -> dict[str, Any]:
    """Film, upload, compare what was found, recover, score."""
    clip, capture_archive, truth = folder / "clip.mp4", folder / "clip.zip", kit.Scene.load(scene)
    args = [
        "--bands",
        NESTED,
        "--fps",
        str(case.fps),
        "--hold",
        str(case.hold),
        "--jitter",
        str(case.jitter),
    ]
    with redirect_stdout(None):
        kit.main(["video", str(scene), str(clip), *args, "--lead", str(LEAD), "--seed", str(SEED)])
    manifest = json.loads(clip.with_suffix(".json").read_text()) | {"mask": "mask.png"}
    with zipfile.ZipFile(capture_archive, "w") as archive:
        archive.writestr("capture.json", json.dumps(manifest))
        archive.writestr("mask.png", kit.png(truth.object_pixels.astype(np.uint8) * 255))
        archive.write(clip, clip.name)
    uploaded = client.upload(capture_archive, name=f"{scene.stem} {case}")
    job = client.wait(uploaded["job"])
    stack = Stack(Objects((folder / "data" / "store").as_uri()), uploaded["id"])
    found, count = stack.attributes["video"], uploaded["frames"]
    wrong, torn = sorted_wrongly(stack, case, count)
    row = {
        "scene": scene.stem,
        **case._asdict(),
        "kB": clip.stat().st_size >> 10,
        "frames": found["frames"],
        "kept": found["kept"],
        "found": stack.frames,
        "shown": count,
        "wrong": wrong,
        "torn": torn,
        "seconds": round(found["frames"] / case.fps, 1),
        "ingest": round(job["run_seconds"], 1),
    }
    if stills is not None:
        row |= {"psnr": round(psnr(kit, truth, client, uploaded["id"]), 2), "stills": round(stills, 2)}
        row["lost"] = round(row["stills"] - row["psnr"], 2)
    return row


def filmed_as_stills(kit: ModuleType, scene: Path, client: Client, folder: Path) -> float:
    """PSNR of stills of the same program by the same camera."""
    capture_archive = folder / "stills.zip"
    with redirect_stdout(None):
        kit.main(
            ["capture", str(scene), str(capture_archive), "--bands", NESTED, "--mask", "--response", "srgb"]
        )
    capture = client.upload(capture_archive, name=f"{scene.stem} stills")["id"]
    return psnr(kit, kit.Scene.load(scene), client, capture)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--scene", action="append", help="Name of a scene; all of them if left out.")
    parser.add_argument("--fps", type=int, action="append")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--no-recovery", action="store_true", help="Ingest alone.")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    kit = load(args.kit)
    rows: list[dict[str, Any]] = []
    with served(args.workers) as (client, folder):
        for scene in sorted(args.scenes.glob("*.npz")):
            if args.scene and scene.stem not in args.scene:
                continue
            stills = None if args.no_recovery else filmed_as_stills(kit, scene, client, folder)
            for case in CASES:
                if args.fps and case.fps not in args.fps:
                    continue
                rows.append(measure(kit, scene, case, client, folder, stills))
                if len(rows) == 1:
                    print("  ".join(f"{name:>8}" for name in rows[0]))
                show(rows[-1])
                if args.json:
                    args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
