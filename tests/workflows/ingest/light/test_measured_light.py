"""The light of patterns: exposures merged by what they say, and frames moved back to one place."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.workflows.ingest.video.camera import film
from tests.workflows.ingest.video.films import CAMERA, IngestFilm
from workflows.images.tone_curves import table
from workflows.ingest.light.measured_light import (
    clipped_from,
    constants_of,
    merge,
    stray_light,
    unclipped_light,
)
from workflows.programs.border import border_light
from workflows.programs.presets import preset
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import fit_photometry

LOOK_UP = table("linear", np.dtype(np.uint8))


def merged(codes: NDArray[np.uint8], given: dict[str, Any], count: int) -> PatternLight:
    return merge(
        lambda n: (LOOK_UP[codes[n]], (codes[n] > 0) & (codes[n] < 255)), given, count, codes.shape[1]
    )[0]


def test_merged_light_leaves_out_clipped_values() -> None:
    codes = np.array(
        [[[51, 0, 255]], [[102, 0, 255]], [[204, 4, 255]], [[255, 8, 255]], [[10, 20, 30]]], np.uint8
    )
    given = {"patterns": [0, 0, 0, 0, 1], "exposures": [0.5, 1.0, 2.0, 4.0, 1.0]}
    light, usable, worth = merged(codes, given, 2)
    assert usable[0].tolist() == [[True, True, False], [True, True, True]]
    np.testing.assert_allclose(worth[0], [[7, 12, 15], [2, 2, 2]])
    np.testing.assert_allclose(light[0, 0, :2] * 255, [357 / 7, 12 / 12], rtol=1e-6)
    np.testing.assert_allclose(light[0, 1] * 255, [5, 10, 15], rtol=1e-6)


def test_clipped_repeat_excludes_its_whole_exposure() -> None:
    codes = np.array([[[250, 100, 9]], [[255, 110, 0]]], np.uint8)
    given = {"patterns": [0, 0], "exposures": [1.0, 1.0]}
    light, usable, worth = merged(codes, given, 1)
    assert usable[0, 0].tolist() == [False, True, False]
    np.testing.assert_allclose(light[0, 0] * 255, [252.5, 105, 4.5])
    np.testing.assert_array_equal(worth, 2)


def test_gain_of_a_pattern_is_the_weighted_gain_of_its_frames() -> None:
    codes = np.array([[[50, 100, 0]], [[100, 255, 0]]], np.uint8)
    given = {"patterns": [0, 0], "exposures": [1.0, 3.0], "gains": [1.2, 0.8]}
    _, gain = merge(lambda n: (LOOK_UP[codes[n]], (codes[n] > 0) & (codes[n] < 255)), given, 1, 1)
    assert gain is not None
    np.testing.assert_allclose(gain[0, 0], [0.9, 1.2, 0.9], rtol=1e-6)


def test_value_merged_from_clipped_ones_is_clipped() -> None:
    codes = np.full((20, 20, 3), 100, np.uint8)
    codes[10, 10, 1] = 255
    _, whole = unclipped_light(codes, (0.4, 0.0), 4, LOOK_UP, 255)
    assert whole[..., [0, 2]].all()
    # two neighbours are made of it, those further on hardly
    assert not whole[6, 5:7, 1].any()
    assert 2 <= np.count_nonzero(~whole) <= 4
    _, still = unclipped_light(codes, (0.0, 0.0), 4, LOOK_UP, 255)
    assert np.count_nonzero(~still) == 1
    _, none = unclipped_light(codes, (0.0, 0.0), 4, LOOK_UP, 100)
    assert not none.any()


@pytest.mark.parametrize(
    ("gain", "least"), [pytest.param(1.0, 65535, marks=pytest.mark.slow), (2.5, int(0.97 * 65535))]
)
def test_values_of_a_film_that_clips_count_as_clipped_a_little_below_full_scale(
    ingest_film: IngestFilm, light: list[np.ndarray], gain: float, least: int
) -> None:
    stack = ingest_film(film([np.float32(gain) * one for one in light], CAMERA).data)
    assert clipped_from(stack) == least


def test_stray_light_of_constant_frames_is_what_s_and_rho_are_fitted_to() -> None:
    program = preset("quick", 640, 480)
    patterns = list(range(program.count))
    plain = stray_light({"patterns": patterns}, program)
    np.testing.assert_array_equal(plain, 1)
    assert plain.shape == (1, program.measured.size + 2)
    strays = stray_light({"patterns": patterns, "border": True}, program)
    lit = border_light(patterns)
    np.testing.assert_array_equal(strays[0], 1)
    np.testing.assert_array_equal(strays[1:, :-2], lit[:, program.measured])
    numbers, sent = constants_of({"patterns": patterns, "border": True}, program)
    seen = np.repeat(0.1 + 0.3 * lit[:, numbers, np.newaxis], 3, axis=2) + 0.2 * sent
    S, rho, *_ = fit_photometry(PatternLight.of(seen), sent, NoiseModel(1e-6, 1e-4))
    for channel in range(3):
        np.testing.assert_allclose(S[:, channel], 0.1 + 0.3 * strays[1:, -2], atol=1e-5)
        np.testing.assert_allclose((S + rho)[:, channel], 0.3 + 0.3 * strays[1:, -1], atol=1e-5)


def test_coloured_constants_tell_s_and_rho_where_no_border_changes_beside_them() -> None:
    program = preset("quick", 640, 480)
    patterns = list(range(program.count))
    numbers, sent = program.constants
    grey = np.ptp(sent, axis=1) == 0
    assert 2 < np.count_nonzero(grey) < grey.size
    np.testing.assert_array_equal(constants_of({"patterns": patterns}, program)[0], numbers)
    beside = {"border": True}
    np.testing.assert_array_equal(constants_of({"patterns": patterns} | beside, program)[0], numbers[grey])
    # A film that lacks all of the black frames can do with what is there.
    coloured = [n for n in patterns if n not in numbers[(sent == 0).all(axis=1)]]
    np.testing.assert_array_equal(
        constants_of({"patterns": coloured} | beside, program)[0], numbers[sent.any(axis=1)]
    )
