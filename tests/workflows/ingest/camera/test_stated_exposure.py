"""Exposures that stills state: they are read from EXIF, and what an automatic exposure has changed is undone."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from storage.layout.captures import Stack
from tests.parts.inputs.heics import heic
from workflows.images.tone_curves import from_light
from workflows.ingest.camera.stated_exposure import (
    APERTURE,
    EXIF,
    SENSITIVITY,
    TIME,
    automatic_exposures,
    stated_exposure,
)
from workflows.ingest.report.report import report
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball

MONITOR = 160, 120
GAIN, OFFSET = 0.8, 0.02
METERED = 0.3
"""The mean light that the camera wants."""


def exif(**tags: float) -> Image.Exif:
    found = Image.Exif()
    numbers = {"time": TIME, "aperture": APERTURE, "sensitivity": SENSITIVITY}
    found.get_ifd(EXIF).update({numbers[name]: value for name, value in tags.items()})
    return found


def picture(kind: str, pixels: NDArray[np.uint8], **tags: float) -> bytes:
    stated = exif(**tags).tobytes()
    if kind == "HEIC":
        return heic(pixels, exif=stated)
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, kind, exif=stated, **({"quality": 95} if kind == "JPEG" else {}))
    return target.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "TIFF", "HEIC"])
@pytest.mark.parametrize(
    ("tags", "exposure"),
    [
        ({"time": 1 / 50, "aperture": 2.0, "sensitivity": 64}, 64 / 200),
        ({"time": 0.5}, 0.5),
        ({"aperture": 2.0}, 0),
        ({"time": 0}, 0),
    ],
)
def test_exposure_is_that_of_exif(kind: str, tags: dict[str, float], exposure: float) -> None:
    data = picture(kind, np.zeros((64, 64, 3), np.uint8), **tags)
    assert stated_exposure(io.BytesIO(data)) == pytest.approx(exposure)


@pytest.mark.parametrize("data", [b"", b"II*\0", picture("JPEG", np.zeros((8, 8, 3), np.uint8), time=1)[:40]])
def test_damaged_files_state_none(data: bytes) -> None:
    assert stated_exposure(io.BytesIO(data)) == 0


@pytest.mark.parametrize("stated", [None, [0.02, 0.0201, 0.02]])
def test_locked_exposures_and_those_of_films_are_not_automatic(stated: list[float] | None) -> None:
    assert automatic_exposures(stated) is None


def test_automatic_exposure_of_stills_is_undone_and_reported(
    make_zip: Callable[..., bytes], ingest: Callable[..., Stack]
) -> None:
    # Too small for trial recoveries, which take long and find no more.
    scene, program = glass_ball(40, 30, monitor=MONITOR, rays=4), preset("sketch", *MONITOR)
    exposures, files = [], {}
    for n, frame in enumerate(scene.film(program, offset=OFFSET, gain=GAIN, depth=16)):
        light = frame / np.float32(65535)
        exposures.append(0.02 * 2 ** round(float(np.clip(np.log2(METERED / light.mean()), -1, 1)), 1))
        codes = 255 * from_light(np.clip(light * np.float32(exposures[-1] / 0.02), 0, 1), "srgb")
        files[f"{n}.jpg"] = picture(
            "JPEG", np.rint(codes).astype(np.uint8), time=exposures[-1], sensitivity=64
        )
    manifest: dict[str, Any] = {
        "format": "envmatte-capture/1",
        "program": program.model_dump(mode="json"),
        "frames": [{"file": name, "pattern": n} for n, name in enumerate(files)],
    }
    stack = ingest("c", make_zip(manifest, files))
    white = min(exposures)
    assert max(exposures) > 2 * white
    np.testing.assert_allclose(stack.attributes["auto_exposure"], np.array(exposures) / white, rtol=1e-3)
    # In units of white's exposure.
    contrast = float(np.median(scene.rho)) * GAIN * white / 0.02
    assert stack.attributes["survey"]["contrast"] == pytest.approx(contrast, rel=0.05)
    (finding,) = (f for f in report(stack.attributes, stack.frames).findings if f.name == "auto_exposure")
    assert "as its files state" in finding.message
    assert "set exposure and ISO by hand for all stills" in finding.remedy
