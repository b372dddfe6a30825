"""What the client declares about a capture before it uploads it."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.client._declared import declared
from tests.parts.captures import nested_program
from workflows.images import integer_formats
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

PARTS = [
    {"kind": "constant", "levels": [0, 1]},
    {"kind": "constant", "colours": [[1, 0, 0]]},
    {"kind": "bernoulli", "columns": 8, "rows": 6, "count": 16, "seed": 1},
    {"kind": "images", "files": ["a.png", "b.png"]},
]


def archive(path: Path, manifest: Any, compression: int = zipfile.ZIP_STORED, **files: bytes) -> Path:
    with zipfile.ZipFile(path, "w", compression) as made:
        made.writestr("capture.json", manifest if isinstance(manifest, bytes) else json.dumps(manifest))
        for name, data in files.items():
            made.writestr(name, data)
    return path


def test_capture_declares_its_frames_and_their_size(tmp_path: Path) -> None:
    path = tmp_path / "ball.zip"
    program = nested_program(bands=((8, 6, 16),), levels=2)
    write_capture(glass_ball.glass_ball(24, 16, rays=1), program, path)
    assert declared(path) == {"frames": 18, "width": 24, "height": 16}


@pytest.mark.parametrize("quality", [30, 95])
def test_size_of_a_jpeg_in_a_compressed_archive(tmp_path: Path, quality: int) -> None:
    image = integer_formats.encode_jpeg(np.zeros((33, 70, 3), np.uint8), quality)
    manifest = {"frames": [{"file": "one", "pattern": 0}] * 5}
    path = archive(tmp_path / "c.zip", manifest, zipfile.ZIP_DEFLATED, one=image)
    assert declared(path) == {"frames": 5, "width": 70, "height": 33}


def test_film_declares_the_frames_of_its_program(tmp_path: Path) -> None:
    manifest = {"program": {"parts": PARTS}, "video": {"file": "film.mp4"}}
    assert declared(archive(tmp_path / "c.zip", manifest)) == {"frames": 2 + 1 + 16 + 2}


@pytest.mark.parametrize("manifest", [b"{", b"[]", {"frames": 3}, {}, {"program": {"parts": [{}]}}])
def test_invalid_manifest_declares_nothing(tmp_path: Path, manifest: Any) -> None:
    assert declared(archive(tmp_path / "c.zip", manifest)) == {}


def test_image_of_unknown_format_declares_no_size(tmp_path: Path) -> None:
    manifest = {"frames": [{"file": "one", "pattern": 0}]}
    assert declared(archive(tmp_path / "c.zip", manifest, one=b"II*\0 and so on")) == {"frames": 1}
    assert declared(archive(tmp_path / "d.zip", manifest)) == {"frames": 1}
    (tmp_path / "e.zip").write_bytes(b"no archive")
    assert declared(tmp_path / "e.zip") == {}
