"""Videos of presets, as `envmatte patterns` writes them, ingested as if a camera had seen nothing but the display."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from storage.errors import CaptureError
from storage.layout import uploads
from storage.layout.captures import Stack
from storage.objects.store import Objects
from workflows.ingest import steps as ingest_steps
from workflows.jobs import Task
from workflows.programs import video
from workflows.programs.border import LEAD_SECONDS
from workflows.programs.files import fitted
from workflows.untrusted.limits import Limits

RATE = 2.0


def prepared(folder: Path) -> Stack:
    """The capture of `film.mp4` and `film.json`, its frames told apart."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.write(folder / "film.json", "capture.json")
        archive.write(folder / "film.mp4", "film.mp4")
    objects = Objects((folder / "store").as_uri())
    objects.put(uploads.part_path("c", "all"), target.getvalue())
    uploads.seal(objects, "c", [uploads.Part("all", len(target.getvalue()))])
    ingest_steps.prepare(objects, Task("j", "c", "", {}, Limits(unpacked=1 << 30, memory=1 << 28)))
    return Stack(objects, "c")


@pytest.mark.parametrize("name", [pytest.param("default", marks=pytest.mark.slow), "quick", "sketch"])
@pytest.mark.parametrize("size", [(384, 288), pytest.param((640, 480), marks=pytest.mark.slow)], ids=str)
def test_every_pattern_is_found(name: str, size: tuple[int, int], tmp_path: Path) -> None:
    program = fitted(name, size, bordered=True)
    video.write(program, tmp_path / "film.mp4", RATE, lambda done, of: None)
    stack = prepared(tmp_path)
    assert stack.attributes["video"]["missing"] == {}
    assert stack.attributes["patterns"] == list(range(program.count))
    at, ticks, _ = stack.shares().T
    shown = np.floor((ticks * stack.attributes["video"]["tick"] - sum(LEAD_SECONDS)) * RATE + 1e-3)
    np.testing.assert_array_equal(shown, at)


@pytest.mark.parametrize("name", [pytest.param("default", marks=pytest.mark.slow), "quick"])
def test_the_film_of_another_program_is_refused(name: str, tmp_path: Path) -> None:
    video.write(fitted(name, (384, 288), bordered=True), tmp_path / "film.mp4", RATE, lambda done, of: None)
    record = json.loads((tmp_path / "film.json").read_text())
    for part in record["program"]["parts"]:
        if "seed" in part:
            part["seed"] += 100
    (tmp_path / "film.json").write_text(json.dumps(record))
    with pytest.raises(CaptureError, match="does not look like"):
        prepared(tmp_path)
