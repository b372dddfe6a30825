"""Capture archives with one thing wrong."""

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from tests.end_to_end.conftest import HEIGHT, WIDTH
from workflows.images import integer_formats


def changed_archive(
    capture_archive: Path | BinaryIO, change: Callable[[dict, dict[str, bytes]], None]
) -> bytes:
    """A capture archive with its capture.json and its files changed."""
    with zipfile.ZipFile(capture_archive) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(files["capture.json"])
    change(manifest, files)
    if "capture.json" in files:
        files["capture.json"] = json.dumps(manifest).encode()
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return target.getvalue()


def no_manifest(manifest: dict, files: dict[str, bytes]) -> None:
    del files["capture.json"]


def other_format(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["format"] = "envmatte-capture/9"


def frame_not_there(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["frames"][3]["file"] = "frames/nowhere.png"


def pattern_without_frame(manifest: dict, files: dict[str, bytes]) -> None:
    del manifest["frames"][7]


def pattern_out_of_range(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["frames"][7]["pattern"] = 5000


def one_level(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["program"]["parts"][0]["levels"] = [0.5] * 5


def path_outside_the_archive(manifest: dict, files: dict[str, bytes]) -> None:
    files["../evil.png"] = b"x"


def monitor_of_width_zero(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["program"]["monitor"]["width"] = 0


def exposure_of_zero(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["frames"][2]["exposure"] = 0


def program_too_large(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["program"]["parts"][1] |= {"columns": 1280, "rows": 960, "count": 100_000}


def video_not_there(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["frames"] = []
    manifest["video"] = {"file": "clip.mp4", "patterns_per_second": 2.0}


def frame_of_another_size(manifest: dict, files: dict[str, bytes]) -> None:
    files["frames/00009.png"] = integer_formats.encode_png(np.zeros((HEIGHT, WIDTH - 1, 3), np.uint8))


def frame_that_is_no_image(manifest: dict, files: dict[str, bytes]) -> None:
    files["frames/00009.png"] = b"this is no image"


def frame_that_is_a_bomb(manifest: dict, files: dict[str, bytes]) -> None:
    # A real PNG whose header claims 60,000 x 60,000 pixels.
    data = bytearray(files["frames/00009.png"])
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    files["frames/00009.png"] = bytes(data)


def frame_of_an_unknown_camera(manifest: dict, files: dict[str, bytes]) -> None:
    manifest["frames"][9]["file"] = "frames/00009.nef"
    files["frames/00009.nef"] = bytes(9000)
