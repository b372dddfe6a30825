"""What clipped values still say of the light."""

import numpy as np

from workflows.recovery.camera.clipped import DEVIATION, NARROWEST, bound_clipped
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry

NOISE = NoiseModel(1e-6, 0)
S, RHO = 0.1, 0.8


def bounded(values: list[float], usable: list[bool], filmed: list[bool]) -> list[np.ndarray]:
    """Values of one pixel, alike in its channels, after `bound_clipped`: (m,) each."""
    m = len(values)
    of_pixel = [np.full((1, 3), value, np.float32) for value in (S, RHO, 1e-6, 1e-6)]
    light = PatternLight(
        np.repeat(np.array(values, np.float32)[np.newaxis, :, np.newaxis], 3, axis=2),
        np.repeat(np.array(usable)[np.newaxis, :, np.newaxis], 3, axis=2),
        np.full((1, m, 3), 2, np.float32),
    )
    found = bound_clipped(light, np.array(filmed), Photometry(*of_pixel), NOISE)
    for one in found:
        np.testing.assert_array_equal(one, np.repeat(one[..., :1], 3, axis=2))
    return [one[0, :, 0] for one in found]


def test_a_clipped_value_counts_as_the_middle_of_what_it_can_have_been() -> None:
    values, usable, worth = bounded([0.5, 0.7, 0.9, 0.2, 0.05], [True, *4 * [False]], 5 * [True])
    assert usable.all()
    least = NARROWEST * RHO
    np.testing.assert_allclose(
        values, [0.5, (0.7 + S + RHO) / 2, 0.9 + least / 2, (S + 0.2) / 2, 0.05], rtol=1e-6
    )
    assert worth[0] == 2
    widths = np.array([S + RHO - 0.7, least, 0.2 - S, 0])
    np.testing.assert_allclose(1e-6 / worth[1:], 1e-6 / 2 + (DEVIATION * widths) ** 2, rtol=1e-4)


def test_a_pattern_without_a_frame_says_nothing() -> None:
    _, usable, _ = bounded([0.5, 0.0, 1.0], [True, False, False], [True, False, True])
    np.testing.assert_array_equal(usable, [True, False, True])
