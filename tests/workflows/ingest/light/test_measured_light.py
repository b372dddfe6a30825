"""The light of patterns: exposures merged by what they say, and frames moved back to one place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from workflows.images.tone_curves import table
from workflows.ingest.light.measured_light import merge, unclipped_light
from workflows.recovery.camera.pattern_light import PatternLight

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
