"""Recovers captures of traced scenes through the service, and scores the composites against the truth.

    python tests/benchmarks/figures.py KIT SCENES [--method pyramid] [--json FILE]

KIT is the path of a `kit.py` that makes captures of scenes and scores composites, SCENES a folder of its scenes
(`*.npz`). For each scene it films the method's program with a mask, uploads the capture, recovers its matte,
requests composites over the kit's backdrops, and prints the PSNR over the object's pixels and the seconds of work
for 1,000 of them.
"""

import argparse
import importlib.util
import json
import sqlite3
import sys
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from services.client import Client
from services.demo import service
from workflows import images

BANDS = {
    "nn-dgsr": "16x12:24,128x96:250",
    "pyramid": "16x12:24,32x24:24,64x48:24,128x96:26,256x192:26",
}


def load(kit: Path) -> ModuleType:
    """Import a kit from its path."""
    spec = importlib.util.spec_from_file_location("kit", kit)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["kit"] = module
    spec.loader.exec_module(module)
    return module


def measure(kit: ModuleType, scene: Path, method: str, client: Client, data: Path) -> dict[str, Any]:
    """Film, upload, recover, composite, score."""
    bundle = data.parent / "capture.zip"
    bands = BANDS[method]
    with redirect_stdout(None):
        kit.main(["capture", str(scene), str(bundle), "--bands", bands, "--noise", "1.0", "--mask"])
    uploaded = client.upload(bundle, name=scene.stem)
    job = client.wait(client.recover(uploaded["id"], method=method)["id"])
    with sqlite3.connect(data / "envmatte.db") as ledger:
        (seconds,) = ledger.execute("select sum(seconds) from tiles where job = ?", (job["id"],)).fetchone()
    truth = kit.Scene.load(scene)
    scores = {}
    for name, backdrop in kit.backdrops().items():
        # 16 bits, so that the matte is scored and not the answer's rounding.
        sent = images.to_integers(backdrop, np.dtype(np.uint16))
        answer = client.composite(job["matte"], images.encode_png(sent), transfer="linear")
        pixels = images.to_unit(images.decode(answer, memory=1 << 28))
        scores[name] = kit.score(truth, images.to_unit(sent), pixels[..., :3])
    return {
        "scene": scene.stem,
        "method": method,
        "frames": uploaded["frames"],
        "pixels": job["pixels"],
        **{name: round(score, 2) for name, score in scores.items()},
        "mean": round(sum(scores.values()) / len(scores), 2),
        "seconds_per_1000_pixels": round(seconds / job["pixels"] * 1000, 2),
        "run_seconds": round(job["run_seconds"], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kit", type=Path)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--method", choices=BANDS, action="append")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    kit = load(given.kit)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder, "data")
        with service(data, given.workers) as url, Client(url) as client:
            for method in given.method or BANDS:
                for scene in sorted(given.scenes.glob("*.npz")):
                    row = measure(kit, scene, method, client, data)
                    if not rows:
                        print("  ".join(f"{name:>8}" for name in row))
                    print(
                        "  ".join(f"{value!s:>{max(8, len(name))}}" for name, value in row.items()),
                        flush=True,
                    )
                    rows.append(row)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
