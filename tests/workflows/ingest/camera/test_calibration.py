"""What frames tell of the camera: tone curves, and noise unless the exposure is free."""

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from workflows.images.integer_formats import decode, encode_png
from workflows.images.tone_curves import table
from workflows.ingest.camera.border_exposure import MOST_APART, BorderValues
from workflows.ingest.camera.calibration import calibrate
from workflows.programs.border import border_light
from workflows.programs.presets import preset
from workflows.recovery.camera.noise import NoiseModel
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

Ingest = Callable[..., Stack]
PROGRAM = preset("sketch", 320, 240)
LOOK_UP = table("srgb", np.dtype(np.uint16))
NOISE, UNEVEN = 0.002, 0.2


class Film:
    """A film, as `calibrate` needs it: its patterns are brighter or darker, by 20 %, than its border tells."""

    channels, height, width, dtype = 3, 60, 80, np.dtype(np.uint16)

    def __init__(self, exposures: NDArray[np.floating]) -> None:
        random = np.random.default_rng(2)
        self.frames = PROGRAM.count
        self.attributes: dict[str, Any] = {
            "program": PROGRAM.model_dump(mode="json"),
            "patterns": list(range(self.frames)),
            "exposures": [1.0] * self.frames,
            "response": "srgb",
            "storage": {"black": 0, "full": 65535, "bounded": True},
            "border": True,
            "video": {},
        }
        numbers, sent = PROGRAM.constants
        shown = random.integers(0, 2, (self.frames, 60, 80, 1)).repeat(3, axis=3).astype(float)
        shown[numbers] = sent[:, np.newaxis, np.newaxis]
        uneven = np.exp(UNEVEN * random.standard_normal((self.frames, 1, 1, 1)))
        uneven[numbers] = 1
        light = (0.03 + 0.4 * shown) * uneven
        lit = border_light(range(self.frames)) > 0
        of_column = lit[np.arange(80) // 4 % len(lit)]  # a cell is four pixels wide
        light[:, :5] = light[:, 55:] = np.where(of_column, 0.3, 0.03).T[:, np.newaxis, :, np.newaxis]
        light *= exposures[:, np.newaxis, np.newaxis, np.newaxis]
        light += NOISE * random.standard_normal(light.shape)
        self.codes = np.interp(light, LOOK_UP, np.arange(65536)).round().astype(np.uint16)

    def read(self, rows: slice = slice(None), columns: slice = slice(None)) -> NDArray[np.uint16]:
        return self.codes[:, rows, columns]

    def read_frames(self, frames: list[int], rows: slice, columns: slice) -> NDArray[np.uint16]:
        return self.codes[frames, rows, columns]

    def read_strips(self, columns: slice) -> None:
        """As of a stack without strips."""

    def read_some(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.uint16]:
        return self.codes[:, rows][:, :, columns]

    def mask(self, rows: slice = slice(None), columns: slice = slice(None)) -> NDArray[np.bool_]:
        mask = np.zeros((self.height, self.width), bool)
        mask[8:52] = True
        return mask[rows, columns]

    def thumbnails(self, frames: NDArray[np.intp]) -> NDArray[np.uint16]:
        return np.asarray(np.rint(self.codes[frames].mean(axis=3)), np.uint16)

    def annotate(self, **attributes: Any) -> None:
        self.attributes |= attributes


def deviation(film: Film) -> float:
    """Of the noise of a middling value."""
    return float(np.sqrt(NoiseModel(**film.attributes["noise"]).variance(np.array([0.25]))[0]))


@pytest.mark.parametrize("free", [False, True])
def test_uneven_patterns_are_noise_unless_the_exposure_was_free(free: bool) -> None:
    steps = np.array([1.0, 1.2 * MOST_APART if free else 1.1])[np.arange(PROGRAM.count) % 2]
    film = cast(Any, Film(steps))
    calibrate(film, BorderValues.of(film))
    np.testing.assert_allclose(
        np.ptp(np.log(film.attributes["auto_exposure"])), np.log(steps.max()), atol=0.05
    )
    assert film.attributes["assumed_noise"] == free
    assert (deviation(film) < UNEVEN * 0.4 / 6) == free  # white is 0.4 brighter than black


@pytest.mark.parametrize(
    ("camera", "monitor", "found"),
    [
        ("unknown", "linear", {"camera_curve": 2.2, "monitor_curve": "linear"}),
        ("linear", "unknown", {"camera_curve": "linear", "monitor_curve": 2.2}),
        ("unknown", "unknown", {"camera_curve": "srgb", "monitor_curve": "srgb"}),
    ],
)
def test_an_unknown_response_is_estimated(
    ingest: Ingest, camera: str, monitor: str, found: dict[str, Any]
) -> None:
    scene = glass_ball(40, 30, monitor=(64, 48), rays=4)
    program = nested_program((64, 48), bands=((4, 3, 4),), levels=8)
    if monitor == "unknown":
        # Levels that a gamma of 2.2 turns into those that were filmed.
        levels = tuple((np.linspace(0, 1, 8) ** (1 / 2.2)).tolist())
    else:
        levels = tuple(np.linspace(0, 1, 8).tolist())
    target = io.BytesIO()
    write_capture(scene, program, target, noise=0.5, depth=16)
    changed = io.BytesIO()
    with zipfile.ZipFile(target) as archive, zipfile.ZipFile(changed, "w") as out:
        for name in archive.namelist():
            data = archive.read(name)
            if name == "capture.json":
                given = json.loads(data)
                given["response"] = camera
                given["program"]["monitor"]["response"] = monitor
                given["program"]["parts"][0]["levels"] = levels
                data = json.dumps(given).encode()
            elif camera == "unknown":
                value = decode(data, memory=1 << 24) / 65535
                data = encode_png(np.rint(value ** (1 / 2.2) * 65535).astype(np.uint16))
            out.writestr(name, data)
    attributes = ingest("c", changed.getvalue()).attributes
    for name, curve in found.items():
        if isinstance(curve, float):
            assert attributes[name]["gamma"] == pytest.approx(curve, abs=0.1)
        else:
            assert attributes[name] == curve


def test_measured_noise_is_that_of_the_camera(ingest: Ingest) -> None:
    scene = glass_ball(80, 60, monitor=(64, 48), rays=4)
    target = io.BytesIO()
    write_capture(scene, nested_program((64, 48), bands=((4, 3, 2),), levels=8), target, noise=2.0, depth=16)
    noise = NoiseModel(**ingest("c", target.getvalue()).attributes["noise"])
    for value in (0.05, 0.3, 0.8):
        # The simulated camera's deviation is 0.002 + 0.006 sqrt(value), times `noise`.
        deviation = float(noise.variance(np.array([value], np.float32))[0]) ** 0.5
        assert deviation == pytest.approx(2 * (0.002 + 0.006 * value**0.5), rel=0.25)
