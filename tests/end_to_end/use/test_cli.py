"""The command line against a real service."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from services.cli.main import main
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service, png
from tests.parts.processes import interrupt, running
from workflows.images import integer_formats
from workflows.programs import presets
from workflows.programs.files import program_json
from workflows.programs.preset_names import PRESETS
from workflows.programs.program import Program


@pytest.mark.slow
def test_from_a_capture_to_a_composite(service: Service, capture_archive: Path, tmp_path: Path) -> None:
    uploaded = envmatte(service, "upload", str(capture_archive), "--name", "by hand")
    assert uploaded.returncode == 0, uploaded.stderr
    assert "upload: 100%" in uploaded.stderr
    capture = uploaded.stdout.strip()
    assert service.client.capture(capture)["name"] == "by hand"

    recovered = envmatte(service, "recover", capture, "--option", "tile=48", "--json")
    job = json.loads(recovered.stdout)
    assert (job["state"], job["options"]["tile"]) == ("succeeded", 48)
    assert "recovery: 100%" in recovered.stderr
    assert envmatte(service, "status", job["id"]).stdout.split() == ["succeeded"]

    backdrop = tmp_path / "backdrop.png"
    backdrop.write_bytes(png(np.full((4, 4, 3), 0.5, np.float32), "srgb", np.uint8))
    composite = tmp_path / "composite.png"
    done = envmatte(service, "composite", job["matte"], str(backdrop), "-o", str(composite))
    assert done.stdout.strip() == str(composite)
    assert integer_formats.decode(composite.read_bytes(), memory=1 << 24).shape == (HEIGHT, WIDTH, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["backdrop.png", "composite.png"]


def test_records_are_listed_and_deleted(
    service: Service, capture_archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [service.client.upload(capture_archive, name=f"listed {n}") for n in range(3)]
    for one in made:
        service.client.wait(one)
    monkeypatch.setattr("services.client._client._PAGE", 2)
    expected = [one.id for one in reversed(made)]
    assert [one.id for one in service.client.captures(name="LISTED")] == expected
    assert [one.id for one in service.client.jobs()][:3] == [one.job for one in reversed(made)]
    listed = envmatte(service, "list", "captures", "--name", "listed", "--state", "ready")
    rows = [line.split("\t") for line in listed.stdout.splitlines()]
    assert [(id, state, name) for id, state, _, name in rows] == [
        (id, "ready", f"listed {n}") for id, n in zip(expected, (2, 1, 0), strict=True)
    ]
    assert envmatte(service, "list", "captures", "--state", "failed", "--name", "listed").stdout == ""
    assert envmatte(service, "delete", "captures", *expected[:2]).stdout == "2 deleted\n"
    assert [one.id for one in service.client.captures(name="listed")] == expected[2:]
    gone = envmatte(service, "delete", "captures", expected[0])
    assert (gone.returncode, gone.stdout) == (1, "")
    assert expected[0] in gone.stderr


def test_films_and_stills_are_packed_with_their_program(tmp_path: Path) -> None:
    shown = Program.model_validate(
        {
            "monitor": {"width": 64, "height": 48},
            "parts": [{"kind": "constant", "levels": [0, 1]}, {"kind": "stripes", "axis": "x", "count": 2}],
        }
    )
    record = tmp_path / "show.json"
    record.write_text(
        json.dumps(
            {
                "format": "envmatte-capture/1",
                "program": program_json(shown),
                "video": {"file": "show.mp4", "patterns_per_second": 2},
            }
        )
    )
    film, stills, archive = tmp_path / "IMG 1.MOV", tmp_path / "stills", tmp_path / "packed.zip"
    film.write_bytes(b"\0\0\0\x14ftypqt  and more")
    stills.mkdir()
    for n in range(shown.count):
        (stills / f"DSC_{8 + n}.NEF").write_bytes(bytes([n]))  # 10 comes after 9

    def pack(*arguments: Path | str) -> tuple[int, str]:
        done = CliRunner().invoke(main, ["pack", *map(str, arguments)])
        return done.exit_code, done.output

    assert pack(record, film, "-o", archive) == (0, f"{archive}\n")
    with zipfile.ZipFile(archive) as packed:
        assert packed.namelist() == ["capture.json", "film.MOV"]
        assert packed.read("film.MOV") == film.read_bytes()
        found = json.loads(packed.read("capture.json"))
        assert (found["name"], found["video"]) == ("IMG 1", {"file": "film.MOV", "patterns_per_second": 2})
    assert pack(record, stills, "-o", archive) == (0, f"{archive}\n")
    with zipfile.ZipFile(archive) as packed:
        found = json.loads(packed.read("capture.json"))
        for n, frame in enumerate(found["frames"]):
            assert frame == {"file": f"{n:05}/DSC_{8 + n}.NEF", "pattern": n}
            assert packed.read(frame["file"]) == bytes([n])
        assert Program.model_validate(found["program"]) == shown
    (stills / "DSC_9.NEF").unlink()
    whole = record.read_text()
    record.write_text(json.dumps(json.loads(whole) | {"video": None}))
    for source, why in (
        (stills, f"{shown.count - 1} files, the program {shown.count}"),
        (film, "describes no film"),
    ):
        code, output = pack(record, source, "-o", archive)
        assert code == 2
        assert why in output
    record.write_text("no JSON")
    assert pack(record, film, "-o", archive)[0] == 2
    record.write_text(whole)
    os.utime(film, (0, 0))  # before the times that a ZIP can hold
    assert pack(record, film, "-o", archive)[0] == 0


def patterns(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "services", "patterns", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_patterns_of_a_preset_are_written(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "patterns"
    done = patterns("sketch", str(folder), "--monitor", "160x120", "--json")
    assert done.returncode == 0, done.stderr
    assert "patterns: 100%" in done.stderr
    program = presets.preset("sketch", 160, 120)
    assert json.loads(done.stdout) == {
        "folder": str(folder),
        "preset": "sketch",
        "monitor": [160, 120],
        "patterns": program.count,
    }
    assert Program.model_validate_json((folder / "program.json").read_text()) == program
    names = [f"{n:05d}.png" for n in range(program.count)]
    assert sorted(path.name for path in folder.iterdir()) == [*names, "program.json"]
    assert [path.name for path in folder.parent.iterdir()] == ["patterns"]
    for name, picture in zip(names, program.pictures(0, program.count), strict=True):
        with Image.open(folder / name) as image:
            pixels = np.asarray(image)
        values = pixels.astype(np.float32) / np.float32(1 if pixels.dtype == bool else 255)
        if pixels.ndim == 2:
            values = np.broadcast_to(values[..., None], picture.shape)
            # As small as possible: 1 bit for black and white.
            assert (pixels.dtype == bool) == set(np.unique(picture)).issubset({0.0, 1.0})
        else:
            assert np.any(picture != picture[..., :1])
        np.testing.assert_array_equal(values, picture)


def test_patterns_for_cameras_that_store_jpeg_are_in_black_and_white(tmp_path: Path) -> None:
    given = ["patterns", "sketch", str(tmp_path), "--monitor", "160x120", "--grey"]
    done = CliRunner().invoke(main, given)
    assert done.exit_code == 0, done.output
    program = Program.model_validate_json((tmp_path / "program.json").read_text())
    assert program == presets.preset("sketch", 160, 120, grey=True)


def test_every_preset_is_described_in_the_help() -> None:
    assert set(PRESETS) == set(presets.RECIPES)
    help_text = CliRunner().invoke(main, ["patterns", "--help"]).output
    for name, text in PRESETS.items():
        assert text.startswith(f"{presets.preset(name).count} frames")
        assert any(line.split(maxsplit=1) == [name, text] for line in help_text.splitlines())


def test_patterns_need_a_new_or_empty_folder(tmp_path: Path) -> None:
    done = patterns("sketch", str(tmp_path), "--monitor", "16x12")
    assert (done.returncode, done.stdout) == (0, f"{tmp_path}\n")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(before) == 38
    again = patterns("default", str(tmp_path), "--monitor", "16x12")
    assert (again.returncode, again.stdout) == (2, "")
    assert "is not empty" in again.stderr
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["best", "x"], "is not one of 'default'"),
        (["quick"], "OUT"),
        (["quick", "x", "--monitor", "1280"], "WIDTHxHEIGHT"),
        (["quick", "x", "--monitor", "2x2"], "too small"),
        (["quick", "x", "--monitor", "99999x960"], "must be at most 16384"),
        (["program.json", "x", "--grey"], "--grey is for presets"),
        (["quick", "x.webm"], "a video is written as .mp4 or .mkv"),
    ],
)
def test_invalid_patterns_are_refused(
    arguments: list[str], reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(main, ["patterns", *arguments])
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert reason in refused.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_film_of_a_preset_and_of_its_manifest(tmp_path: Path) -> None:
    film = tmp_path / "new" / "sketch.mp4"
    done = patterns("sketch", str(film), "--monitor", "320x240", "--rate", "10", "--json")
    assert done.returncode == 0, done.stderr
    assert "patterns: 100% 47 of 47" in done.stderr
    assert json.loads(done.stdout) == {
        "video": str(film),
        "preset": "sketch",
        "monitor": [296, 216],
        "patterns": 37,
    }
    assert sorted(path.name for path in film.parent.iterdir()) == ["sketch.json", "sketch.mp4"]
    again = patterns(str(film.with_suffix(".json")), str(tmp_path / "again.mp4"), "--rate", "10")
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "again.mp4").read_bytes() == film.read_bytes()
    refused = patterns("sketch", str(film))
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "exists already" in refused.stderr


@pytest.mark.parametrize(("out", "first"), [("patterns", "1 of 432"), ("patterns.mkv", "1 of 442")])
@pytest.mark.slow
def test_interrupted_patterns_leave_nothing(out: str, first: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "services", "patterns", "paper-400", str(tmp_path / out)]
    with running(command) as writing:
        assert writing.stderr is not None
        assert first in writing.stderr.readline()
        code, stderr = interrupt(writing)
    assert code == 130
    assert "Interrupted" in stderr
    assert not list(tmp_path.iterdir())
