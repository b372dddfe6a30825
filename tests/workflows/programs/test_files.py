"""Programs fitted to a screen, and their files."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from storage.errors import OptionError
from workflows.programs.files import fit_to_screen, load_program, pictures, png, program_json, zip_program
from workflows.programs.presets import preset
from workflows.programs.program import Program

SKETCH = preset("sketch", 160, 120)


def test_a_program_comes_from_a_preset_or_a_file(tmp_path: Path) -> None:
    assert load_program("sketch") == "sketch"
    file = tmp_path / "program.json"
    for text in (program_json(SKETCH), {"format": "envmatte-capture/1", "program": program_json(SKETCH)}):
        file.write_text(json.dumps(text))
        assert load_program(str(file)) == SKETCH


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "is not JSON"),
        ("[1]", "has no program: must be an object"),
        ("{}", "has no program: monitor is required"),
        ('"\\ud800"', "has no program: must be an object"),
    ],
)
def test_a_file_without_a_program_is_refused_by_its_name(text: str, reason: str, tmp_path: Path) -> None:
    file = tmp_path / "program.json"
    file.write_text(text)
    with pytest.raises(OptionError) as caught:
        load_program(str(file))
    assert caught.value.detail.startswith(f"{file} {reason}")
    with pytest.raises(OptionError, match=r"is not one of 'default'.* nor a file"):
        load_program(str(tmp_path))


def test_screen_equals_the_monitor_or_surrounds_it_with_a_border() -> None:
    def size(of: str | Program, screen: tuple[int, int] | None, bordered: bool) -> tuple[int, int]:
        monitor = fit_to_screen(of, screen, bordered=bordered).monitor
        return monitor.width, monitor.height

    for of in ("sketch", SKETCH):
        assert size(of, (1920, 1080), False) == (1920, 1080)
        assert size(of, (1920, 1080), True) == (1812, 972)
    assert size("sketch", None, False) == (1280, 960)
    assert size("sketch", None, True) == (1184, 864)
    for bordered in (False, True):
        assert fit_to_screen(SKETCH, None, bordered=bordered) == SKETCH


def test_program_that_cannot_be_fitted_to_a_screen_is_refused() -> None:
    with pytest.raises(OptionError, match=r"on a monitor of 90 x 90 pixels: a grid of .* is finer"):
        fit_to_screen(SKETCH, (90, 90), bordered=False)
    images = program_json(SKETCH)
    images["parts"].append({"kind": "images", "files": ["a.png"]})
    with pytest.raises(OptionError, match="part of images"):
        fit_to_screen(Program.model_validate(images), None, bordered=False)


def test_an_archive_has_the_manifest_and_every_picture() -> None:
    parts = list(zip_program(SKETCH))
    assert max(map(len, parts)) < 12_000  # of one picture each, and at the end the directory
    assert b"".join(zip_program(SKETCH)) == b"".join(parts)
    with zipfile.ZipFile(io.BytesIO(b"".join(parts))) as found:
        assert found.testzip() is None
        assert found.namelist() == ["program.json", *(f"{n:05d}.png" for n in range(37))]
        assert Program.model_validate_json(found.read("program.json")) == SKETCH
        for n, picture in enumerate(pictures(SKETCH)):
            data = found.read(f"{n:05d}.png")
            assert data == png(picture)
            pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
            np.testing.assert_array_equal(pixels, np.broadcast_to(picture, pixels.shape))


def test_some_pictures_are_those_of_all() -> None:
    every = list(pictures(SKETCH))
    for first, last in ((0, 1), (7, 12), (31, 32)):
        for one, other in zip(pictures(SKETCH, first, last), every[first:last], strict=True):
            np.testing.assert_array_equal(one, other)
