"""The exposures of a film's frames, by the light of its border."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.images.tone_curves import table
from workflows.ingest.camera.border_exposure import (
    TRIFLE,
    BorderValues,
    relative_to_white,
    shortest_white,
)
from workflows.programs.border import border_light
from workflows.programs.presets import preset

PROGRAM = preset("sketch", 320, 240)
LOOK_UP = table("srgb", np.dtype(np.uint16))


class Film:
    """What `BorderValues` needs of a stack: the border around a picture that changes at random."""

    channels = 3

    def __init__(
        self,
        exposures: NDArray[np.floating],
        border: bool = True,
        missing: int = 0,
        veil: NDArray[np.floating] | float = 0.0,
        between: bool = False,
        clipped: bool = False,
        contrasty: bool = False,
        dark: int = 0,
        recorded: bool = False,
    ) -> None:
        random = np.random.default_rng(2)
        self.frames = PROGRAM.count - missing
        self.attributes: dict[str, Any] = {"patterns": list(range(missing, PROGRAM.count))}
        light = np.repeat(random.uniform(0, 0.6, (self.frames, 60, 80, 1)), 3, axis=3)
        if clipped:  # what is dark is no light at all to the camera
            light = np.where(light > 0.3, 0.6, -0.1)
        if border:
            lit = border_light(range(PROGRAM.count))[:, missing:] > 0
            of_column = lit[np.arange(80) // 4 % len(lit)]  # a cell is four pixels wide
            shown = np.where(of_column, 0.3, 0.03)
            if contrasty:  # only edges of cells are neither black nor nearly white
                shown = np.where(of_column, 0.97, -0.1)
                shown[::8] = (shown[::8] + np.roll(shown, -4, axis=0)[::8]) / 2
            light[:, :5] = light[:, 55:] = shown.T[:, np.newaxis, :, np.newaxis]
            if between:  # four rows see the patterns' edge too
                light[:, 5:9] = 0.7 * light[:, :1] + 0.1 * random.random((self.frames, 1, 1, 1))
        light += np.broadcast_to(veil, PROGRAM.count)[missing:, np.newaxis, np.newaxis, np.newaxis]
        light *= np.asarray(exposures)[: self.frames, np.newaxis, np.newaxis, np.newaxis]
        # No camera: only what compression leaves of black beside white is neither black nor white.
        if recorded:
            lit = light > 0.2
            light = np.where(
                lit, 1.0, 0.003 * random.random((self.frames, 1, 1, 1)) * np.roll(lit, 4, axis=2)
            )
        else:
            light += 0.002 * random.standard_normal(light.shape)
        self.dtype = np.dtype(np.uint16)
        self.codes = np.interp(light, LOOK_UP, np.arange(65536)).round().astype(np.uint16)
        # A room so dark that compression has made it black.
        self.codes = np.pad(self.codes, ((0, 0), (dark, dark), (dark, dark), (0, 0)))
        self.height, self.width = self.codes.shape[1:3]

    def read_strips(self, columns: slice) -> None:
        """As of a stack without strips."""

    def read_some(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.uint16]:
        return self.codes[:, rows][:, :, columns]


@pytest.mark.parametrize("missing", [0, 3])
def test_exposures_are_followed_by_the_border(missing: int) -> None:
    drift = np.exp(np.linspace(-0.05, 0.05, PROGRAM.count) + 0.1 * np.sin(np.arange(PROGRAM.count)))
    found = BorderValues(Film(drift, missing=missing), PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    true = drift[: PROGRAM.count - missing]
    np.testing.assert_allclose(found, true / np.median(true), rtol=0.02)


def test_the_border_is_found_in_a_dark_room() -> None:
    drift = np.exp(0.1 * np.sin(np.arange(PROGRAM.count)))
    film = Film(drift, dark=200)
    values = BorderValues(film, PROGRAM)  # type: ignore[arg-type]
    y, x = values.places - 200
    assert ((y >= 0) & (y < 60) & (x >= 0) & (x < 80)).all()
    found = values.exposures(LOOK_UP)
    assert found is not None
    np.testing.assert_allclose(found, drift / np.median(drift), rtol=0.02)


def test_veil_of_bright_patterns_is_no_exposure() -> None:
    drift = np.exp(np.linspace(-0.03, 0.03, PROGRAM.count))
    veil = 0.02 * np.random.default_rng(4).random(PROGRAM.count)
    found = BorderValues(Film(drift, veil=veil), PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_allclose(found, drift / np.median(drift), rtol=0.01)


def test_values_that_see_the_edge_of_the_patterns_hardly_count() -> None:
    film = Film(np.ones(PROGRAM.count), between=True)
    found = BorderValues(film, PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    assert np.log(found).std() < TRIFLE


def test_exposures_ignore_the_few_edges_of_a_border_of_black_and_white() -> None:
    found = BorderValues(Film(np.ones(200), contrasty=True), PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_allclose(found, 1, rtol=0.02)


def test_exposures_ignore_what_is_left_of_black_in_a_recorded_screen() -> None:
    found = BorderValues(Film(np.ones(200), recorded=True), PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_array_equal(found, 1)


def test_light_of_the_border_is_separated_from_the_veil() -> None:
    veil = 0.02 * np.random.default_rng(4).random(PROGRAM.count)
    found = BorderValues(Film(np.ones(PROGRAM.count), veil=veil), PROGRAM).fit(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    y, _ = found.places
    assert found.own.shape == found.rest.shape == (PROGRAM.count, y.size)
    assert not ((y >= 5) & (y < 55)).any()
    # Of three channels, without the bits' part.
    assert found.rest.std() == pytest.approx(0.002 / np.sqrt(3), rel=0.2)
    assert found.own.max() > 0.29


def test_picture_that_is_mostly_clipped_is_no_border() -> None:
    film = Film(np.ones(PROGRAM.count), clipped=True)
    found = BorderValues(film, PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    assert np.log(found).std() < TRIFLE


def test_frames_exposed_half_as_long_and_twice_are_followed() -> None:
    steps = np.array([0.5, 1.0, 2.0])[np.arange(PROGRAM.count) % 3]
    found = BorderValues(Film(steps), PROGRAM).exposures(LOOK_UP)  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_allclose(found / found[1], steps, rtol=0.03)


def test_without_a_border_in_the_picture_nothing_is_said() -> None:
    film = Film(np.ones(PROGRAM.count), border=False)
    assert BorderValues(film, PROGRAM).exposures(LOOK_UP) is None  # type: ignore[arg-type]


def test_white_is_the_unit_of_a_camera_that_was_not_locked() -> None:
    numbers, sent = PROGRAM.constants
    first, middle, last = numbers[(sent == 1).all(axis=1)]
    exposures = np.full(PROGRAM.count, 1.5)
    exposures[[first, middle, last]] = 0.6, 0.5, 0.5
    found = relative_to_white(exposures, range(PROGRAM.count), PROGRAM)
    np.testing.assert_allclose(found[[first, 1, middle]], [1.2, 3, 1])
    assert shortest_white(exposures, range(PROGRAM.count), PROGRAM) == middle
    some = range(first + 1, middle)
    assert shortest_white(exposures[some], some, PROGRAM) is None
    np.testing.assert_array_equal(relative_to_white(exposures[some], some, PROGRAM), exposures[some])
