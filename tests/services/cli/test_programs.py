"""Commands for programs: what they refuse, and what their help says."""

import itertools
import json
import os
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from services.cli.main import main
from services.cli.programs import shown_program
from services.cli.remote.tether import _stills


def test_help_names_the_file_beside_a_video_as_it_is_written() -> None:
    for name in ("patterns", "tether"):
        described = CliRunner().invoke(main, [name, "--help"]).stdout
        assert (".json" in described, "capture.json" in described) == (True, False), name


def test_a_file_without_a_program_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{}")
    file = str(tmp_path / "bad.json")
    for command in (
        ["patterns", file, str(tmp_path / "out")],
        ["pack", file, str(tmp_path), "-o", str(tmp_path / "x.zip")],
        ["tether", file, str(tmp_path)],
    ):
        done = CliRunner().invoke(main, command)
        assert done.exit_code == 2
        assert f"{file} has no program: monitor is required" in done.stderr


@pytest.mark.parametrize(
    ("numbers", "seconds", "taken"),
    [
        ("0001 0002 9999", "8 9 7", "9999 0001 0002"),
        ("0001 0002 9999", "7 8 9", "0001 0002 9999"),  # of two series
        ("0001 0002 0090", "8 9 7", "0001 0002 0090"),
        ("1 2 20269999", "8 9 7", "1 2 20269999"),
    ],
)
def test_stills_after_9999_are_the_last(tmp_path: Path, numbers: str, seconds: str, taken: str) -> None:
    camera, program, archive = (tmp_path / name for name in ("stills", "program.json", "stills.zip"))
    camera.mkdir()
    for number, second in zip(numbers.split(), seconds.split(), strict=True):
        (camera / f"DSC_{number}.JPG").write_bytes(b"still")
        os.utime(camera / f"DSC_{number}.JPG", (int(second), int(second)))
    grid = {"kind": "bernoulli", "columns": 2, "rows": 2, "count": 1, "seed": 1}
    parts = [{"kind": "constant", "levels": [0.0, 1.0]}, grid]
    program.write_text(json.dumps({"monitor": {"width": 8, "height": 8}, "parts": parts}))
    done = CliRunner().invoke(main, ["pack", str(program), str(camera), "-o", str(archive)])
    assert done.exit_code == 0, done.stderr
    with zipfile.ZipFile(archive) as made:
        frames = json.loads(made.read("capture.json"))["frames"]
    files = [frame["file"].partition("/")[2] for frame in sorted(frames, key=lambda one: one["pattern"])]
    assert files == [f"DSC_{number}.JPG" for number in taken.split()]
    note = "the camera's numbers began again: DSC_0001.JPG is taken as the one after DSC_9999.JPG\n"
    assert done.stderr == (note if taken != numbers else "")
    # While the camera takes them, this is noticed once the first of them is there.
    (found,) = list(itertools.islice(_stills(camera, shown_program(program), ""), 1))
    assert list(found.files) == [frame["file"] for frame in frames]
