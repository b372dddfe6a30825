"""Mattes while a camera takes stills or records a film, by the command line against a real service."""

import json
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from services.cli.main import main
from services.client import Capture, Client, Job, Matte, NotFound
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import Service
from tests.parts.processes import running
from tests.workflows.ingest.video.camera import Camera, film, lights
from tests.workflows.ingest.video.camera import capture as capture_json
from workflows.programs.program import Program
from workflows.simulation.scene import Scene

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


@pytest.fixture
def uploaded(service: Service, capture_archive: Path, tmp_path: Path) -> Matte:
    """The matte of the whole capture, uploaded without the camera's curve, which the command does not know either."""
    with zipfile.ZipFile(capture_archive) as source, zipfile.ZipFile(tmp_path / "whole.zip", "w") as whole:
        for name in source.namelist():
            data = source.read(name)
            if name == "capture.json":
                data = json.dumps(json.loads(data) | {"response": "unknown"}).encode()
            whole.writestr(name, data)
    capture = service.client.upload(tmp_path / "whole.zip")
    service.client.wait(capture)
    return service.client.matte(service.client.wait(service.client.recover(capture)))


@contextmanager
def tethered(service: Service, program: str, source: Path) -> "Iterator[subprocess.Popen[str]]":
    """The command, beside the test."""
    command = [sys.executable, "-m", "services", "tether", program, str(source), "--name", "tethered"]
    with running([*command, "--url", service.url]) as process:
        yield process


def draft_of(service: Service, process: "subprocess.Popen[str]", patterns: str) -> Matte:
    """The draft that is printed next, which can be composited."""
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.match(rf"{patterns} patterns, .*#/mattes/(\w+)$", line):
            break
    assert found
    draft = service.client.matte(found[1])
    assert draft.options["quality"] == "fast"
    assert service.client.composite(draft, np.full((4, 4, 3), 0.5, np.float32)).shape[2] == 3
    return draft


def last_of(service: Service, process: "subprocess.Popen[str]", draft: Matte) -> Matte:
    """The last matte, for which the draft has been deleted."""
    last = process.communicate(timeout=100)[0].strip()
    assert process.returncode == 0
    with pytest.raises(NotFound):
        service.client.matte(draft)
    return service.client.matte(last)


@pytest.fixture(scope="module")
def recording(scene: Scene, program: Program) -> bytes:
    """A film of the program."""
    return film(lights(scene, program), Camera(container="matroska")).data


@pytest.fixture
def film_json(program: Program, tmp_path: Path) -> str:
    """A file with the capture.json of the film."""
    path = tmp_path / "patterns.json"
    path.write_text(json.dumps(capture_json(program, b"", 1 / Camera().hold)[0]))
    return str(path)


def test_there_is_a_draft_while_stills_come_and_at_last_the_matte_of_all(
    service: Service, uploaded: Matte, program: Program, session: tuple[str, list[Path], Path]
) -> None:
    file, stills, camera = session
    with tethered(service, file, camera) as process:
        draft = draft_of(service, process, rf"{FEW} of {program.count}")
        for still in stills[FEW:]:
            shutil.copy(still, camera)
        made = last_of(service, process, draft)
    capture = service.client.capture(str(made.capture))
    assert (capture.frames, capture.name) == (program.count, "tethered")
    backdrop = np.full((4, 4, 3), 0.5, np.float32)
    np.testing.assert_array_equal(
        service.client.composite(made, backdrop), service.client.composite(uploaded, backdrop)
    )


def test_a_draft_that_paused_continues_after_an_interrupt(
    service: Service, session: tuple[str, list[Path], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, stills, camera = session
    module = sys.modules["services.cli.remote.tether"]
    drafts: list[Job] = []

    def unfinished(client: Client, capture: Capture) -> Job:
        drafts.append(client.pause(client.recover(capture, quality="fast")))
        monkeypatch.setattr(module, "ingest", interrupted)
        shutil.copy(stills[FEW], camera)
        return drafts[0]

    def interrupted(*_: object) -> Capture:
        assert service.client.job(drafts[0])["paused"]
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_recover_draft", unfinished)
    with pytest.raises(click.Abort):
        main(["tether", file, str(camera), "--url", service.url], standalone_mode=False)
    assert not service.client.job(drafts[0])["paused"]


def test_it_stops_at_the_quality_that_was_asked_for(
    service: Service, program: Program, session: tuple[str, list[Path], Path]
) -> None:
    file, _, camera = session
    done = envmatte(service, "tether", file, str(camera), "--until", "1", "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["patterns"] == FEW
    assert answer["quality"]["low"] >= 1
    report = service.client.report(answer["capture"])
    (frames,) = (one for one in report["findings"] if one["name"] == "frames")
    assert (frames["level"], str(program.count) in frames["message"]) == ("good", True)


def test_there_is_a_draft_while_a_film_is_recorded(
    service: Service, program: Program, recording: bytes, film_json: str, tmp_path: Path
) -> None:
    growing = tmp_path / "film.mkv"
    growing.write_bytes(recording[:1000])
    with tethered(service, film_json, growing) as process:
        assert process.stderr is not None
        assert any(line.startswith("not yet: ") for line in process.stderr)
        with growing.open("ab") as target:
            target.write(recording[1000 : len(recording) // 2])
        draft = draft_of(service, process, rf"\d+ of {program.count}")
        with growing.open("ab") as target:
            target.write(recording[len(recording) // 2 :])
        made = last_of(service, process, draft)
    capture = service.client.capture(str(made.capture))
    assert (capture.frames, capture.name, made.options["quality"]) == (program.count, "tethered", "fine")
    listed = service.http.get("/v1/captures", params={"limit": 1000}).json()["captures"]
    assert not [one for one in listed if (one["name"], one["state"]) == ("tethered", "failed")]


@pytest.mark.exhaustive
def test_a_film_that_ends_early_is_recovered_as_far_as_it_goes(
    service: Service, program: Program, recording: bytes, film_json: str, tmp_path: Path
) -> None:
    short = tmp_path / "film.mkv"
    short.write_bytes(recording[: len(recording) // 2])
    done = envmatte(service, "tether", film_json, str(short), "--json")
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert 8 < answer["patterns"] < program.count
    assert service.client.matte(answer["matte"]).options["quality"] == "fine"


def test_a_program_that_was_not_made_for_a_film_is_refused(
    service: Service, session: tuple[str, list[Path], Path], tmp_path: Path
) -> None:
    (tmp_path / "film.mkv").write_bytes(b"film")
    refused = envmatte(service, "tether", session[0], str(tmp_path / "film.mkv"))
    assert refused.returncode == 2
    assert "describes no film" in refused.stderr


def test_a_folder_with_files_of_two_kinds_is_refused(
    service: Service, session: tuple[str, list[Path], Path]
) -> None:
    file, _, camera = session
    (camera / "00000.nef").write_bytes(b"raw")
    refused = envmatte(service, "tether", file, str(camera))
    assert refused.returncode == 2
    assert ".nef, .png: leave stills of one kind" in refused.stderr
