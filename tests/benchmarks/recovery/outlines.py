"""How well objects are cut out of captures without a mask, and the time that it saves.

    python -m tests.benchmarks.recovery.outlines TOOL SCENE ... [--case phone_film,raw_stills] [--preset quick]
        [--json FILE]

TOOL is a script whose ``make`` films a traced scene as a device would. SCENE is an npz with the object's ``coverage``
and its ``size``, which stands in the middle of the frame. Each capture is recovered by `quality: fast` twice: as a
whole, and with `cut_out`. The outline is compared with the pixels that the object covers by more than half.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from services.client import Client
from tests.benchmarks.recovery.kits import served, show

CASES = ("raw_stills", "jpeg_stills", "phone_film")
NEAR = 2
"""Pixels that the outline may be off by."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tool")
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--case", default=",".join(CASES))
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = []
    with served(workers=2) as (client, folder):
        for scene in given.scenes:
            for case in given.case.split(","):
                made = folder / "capture.zip"
                words = ["make", str(scene), str(made), "--case", case, "--preset", given.preset]
                subprocess.run(
                    [sys.executable, given.tool, *words, "--set", "mask=0"], check=True, capture_output=True
                )
                rows.append({"scene": scene.stem, "case": case} | measure(client, made, scene))
                if len(rows) == 1:
                    print("  ".join(f"{name:>8}" for name in rows[0]))
                show(rows[-1])
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))


def measure(client: Client, archive: Path, scene: Path) -> dict[str, Any]:
    """Recover a capture as a whole and cut out; returns the pixels of the outline and the seconds."""
    capture = client.upload(archive)
    client.wait(capture["job"])
    seconds = {}
    for name, cut_out in (("whole_s", False), ("cut_s", True)):
        start = time.perf_counter()
        job = client.wait(client.recover(capture, quality="fast", cut_out=cut_out))
        seconds[name] = round(time.perf_counter() - start, 1)
    shown = client.matte(job).layers["alpha"] > 0
    covered = coverage_of(scene, shown.shape) > 0.5
    return {
        "kept": int(shown.sum()),
        "object": int(covered.sum()),
        "too many": int((shown & ~binary_dilation(covered, iterations=NEAR)).sum()),
        "lost": int((binary_erosion(covered, iterations=NEAR) & ~shown).sum()),
    } | seconds


def coverage_of(scene: Path, frame: tuple[int, ...]) -> NDArray[np.float32]:
    """The share of each pixel of a frame that the object of a scene covers."""
    with np.load(scene) as found:
        width, height = found["size"].tolist()
        coverage = found["coverage"].astype(np.float32).reshape(height, width)
    beside = [(whole - part) // 2 for whole, part in zip(frame, coverage.shape, strict=True)]
    return np.pad(
        coverage,
        [(n, whole - part - n) for n, whole, part in zip(beside, frame, coverage.shape, strict=True)],
    )


if __name__ == "__main__":
    main()
