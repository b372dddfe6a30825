"""The noise of films: of a locked exposure it is measured at once, of a free one it is left to the trial recovery."""

from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.images.tone_curves import table
from workflows.ingest.camera.border_exposure import BorderValues
from workflows.ingest.camera.calibration import MOST_APART, measure
from workflows.programs.border import border_light
from workflows.programs.presets import preset
from workflows.recovery.camera.noise import NoiseModel

PROGRAM = preset("sketch", 320, 240)
LOOK_UP = table("srgb", np.dtype(np.uint16))
NOISE, UNEVEN = 0.002, 0.2


class Film:
    """What `measure` needs of a stack: a film whose patterns are brighter or darker, by 20 %, than its border tells."""

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

    def read_some(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.uint16]:
        return self.codes[:, rows][:, :, columns]

    def mask(self) -> NDArray[np.bool_]:
        mask = np.zeros((self.height, self.width), bool)
        mask[8:52] = True
        return mask

    def read_masked(self, rows: slice, columns: slice) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
        return self.read(rows, columns), self.mask()[rows, columns]

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
    measure(film, BorderValues.of(film))
    np.testing.assert_allclose(
        np.ptp(np.log(film.attributes["auto_exposure"])), np.log(steps.max()), atol=0.05
    )
    assert film.attributes["assumed_noise"] == free
    assert (deviation(film) < UNEVEN * 0.4 / 6) == free  # white is 0.4 brighter than black
