"""Mattes while a tethered camera takes stills, by the command line against a real service."""

import json
import re
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.client import NotFound
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import Service
from tests.parts.processes import running
from workflows.programs.program import Program

FEW = 16
"""Stills of five levels and eleven patterns."""


@pytest.fixture
def session(capture_archive: Path, tmp_path: Path) -> tuple[str, list[Path], Path]:
    """A file with the program, the stills of a whole capture in order, and the camera's folder with the first few."""
    with zipfile.ZipFile(capture_archive) as source:
        manifest: dict[str, Any] = json.loads(source.read("capture.json"))
        source.extractall(tmp_path / "all")
    frames = sorted(manifest["frames"], key=lambda frame: frame["pattern"])
    program, camera = tmp_path / "program.json", tmp_path / "camera"
    program.write_text(json.dumps(manifest["program"]))
    camera.mkdir()
    stills = [tmp_path / "all" / frame["file"] for frame in frames]
    for still in stills[:FEW]:
        shutil.copy(still, camera)
    return str(program), stills, camera


def test_there_is_a_draft_while_stills_come_and_at_last_the_matte_of_all(
    service: Service, matte: str, program: Program, session: tuple[str, list[Path], Path]
) -> None:
    file, stills, camera = session
    command = [sys.executable, "-m", "services", "tether", file, str(camera), "--name", "tethered"]
    with running([*command, "--url", service.url]) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        for line in process.stderr:
            if found := re.match(rf"{FEW} of {program.count} stills, .*#/mattes/(\w+)$", line):
                break
        assert found
        draft = service.client.matte(found[1])
        assert draft.options["quality"] == "fast"
        backdrop = np.full((4, 4, 3), 0.5, np.float32)
        assert service.client.composite(draft, backdrop).shape[2] == 3
        for still in stills[FEW:]:
            shutil.copy(still, camera)
        last = process.communicate(timeout=100)[0].strip()
        assert process.returncode == 0
    with pytest.raises(NotFound):
        service.client.matte(draft)
    made = service.client.matte(last)
    capture = service.client.capture(str(made.capture))
    assert (capture.frames, capture.name) == (program.count, "tethered")
    np.testing.assert_array_equal(
        service.client.composite(made, backdrop), service.client.composite(matte, backdrop)
    )


def test_it_stops_at_the_quality_that_was_asked_for(
    service: Service, program: Program, session: tuple[str, list[Path], Path]
) -> None:
    file, _, camera = session
    done = envmatte(service, "tether", file, str(camera), "--until", "1", "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["stills"] == FEW
    assert answer["quality"]["low"] >= 1
    report = service.client.report(answer["capture"])
    (frames,) = (one for one in report["findings"] if one["name"] == "frames")
    assert (frames["level"], str(program.count) in frames["message"]) == ("good", True)


def test_a_folder_with_files_of_two_kinds_is_refused(
    service: Service, session: tuple[str, list[Path], Path]
) -> None:
    file, _, camera = session
    (camera / "00000.nef").write_bytes(b"raw")
    refused = envmatte(service, "tether", file, str(camera))
    assert refused.returncode == 2
    assert ".nef, .png: leave stills of one kind" in refused.stderr
