"""Compares the ETA of jobs after a fifth of their tiles with the time they then take.

    python -m tests.benchmarks.cluster.eta [--size 160x120 --size 320x240] [--repeat 2] [--workers 2] [--json FILE]

For each size it traces a glass ball, films the preset `default` as stills and as an unsynchronised video, ingests both
through a real service and recovers the stills, and prints for each job: its tiles, seconds from its start to its end,
the ETA when a fifth of the tiles was done, the seconds that passed from then on until it had succeeded, and by how many
per cent the ETA was off. Run it from the root of the repository.
"""

import argparse
import io
import json
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from services.client import Client
from tests.benchmarks.recovery.kits import served, show
from tests.workflows.ingest.video.camera import Camera, capture, film, lights
from workflows.images import integer_formats
from workflows.programs.presets import preset
from workflows.simulation import glass_ball
from workflows.simulation.scene import Scene, write_capture

SHARE = 0.2
CAMERA = Camera(hold=0.25, options={"crf": "12"})


def stills(scene: Scene) -> bytes:
    """A capture archive of the scene."""
    target = io.BytesIO()
    write_capture(scene, preset("default"), target)
    return target.getvalue()


def video(scene: Scene) -> bytes:
    """A capture archive with a recording of the scene."""
    program = preset("default")
    manifest, files = capture(program, film(lights(scene, program), CAMERA).data, 1 / CAMERA.hold)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("capture.json", json.dumps(manifest | {"mask": "mask.png"}))
        archive.writestr(
            "mask.png", integer_formats.encode_png(scene.object_mask.astype(np.uint8)[..., None] * 255)
        )
        for name, data in files.items():
            archive.writestr(name, data)
    return target.getvalue()


def follow(client: Client, job: str) -> dict[str, Any]:
    """Watch a job to its end."""
    seen: list[tuple[float, dict[str, Any]]] = []
    done = client.wait(job, progress=lambda found: seen.append((time.monotonic(), found)), poll=0.05)
    end = seen[-1][0]
    fifth = next(
        (at, found)
        for at, found in seen
        if found["tiles"]["total"] and found["tiles"]["done"] >= SHARE * found["tiles"]["total"]
    )
    finishing = next((at for at, found in seen if found["stage"] == "finishing"), end)
    eta, left = fifth[1]["eta_seconds"], end - fifth[0]
    return {
        "tiles": done["tiles"]["total"],
        "seconds": round(done["run_seconds"], 1),
        "finishing": round(end - finishing, 1),
        "at": fifth[1]["tiles"]["done"],
        "eta": None if eta is None else round(eta, 1),
        "left": round(left, 1),
        "off_percent": None if eta is None else round(100 * (eta - left) / left),
    }


def upload(client: Client, capture_archive: bytes, folder: Path) -> dict[str, Any]:
    path = folder / "capture.zip"
    path.write_bytes(capture_archive)
    made: dict[str, Any] = client.upload(path)
    path.unlink()
    return made


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", action="append", metavar="WIDTHxHEIGHT")
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with served(args.workers) as (client, folder):

        def follow_and_show(name: str, size: str, job: str) -> None:
            rows.append({"job": name, "size": size, **follow(client, job)})
            if len(rows) == 1:
                print("  ".join(f"{name:>8}" for name in rows[0]))
            show(rows[-1])

        for size in args.size or ("160x120", "320x240"):
            scene = glass_ball.glass_ball(*map(int, size.split("x")), rays=16)
            archives = {"stills": stills(scene), "video": video(scene)}
            for _ in range(args.repeat):
                for name, capture_archive in archives.items():
                    made = upload(client, capture_archive, folder)
                    follow_and_show(name, size, made["job"])
                    if name == "stills":
                        follow_and_show("recover", size, client.recover(made["id"])["id"])
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
