"""The backdrop around the glass."""

import numpy as np
import pytest

from workflows.composite.backdrops.around import put_around
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.backdrops.placement import Placement
from workflows.composite.engine import Window

FRAME, MONITOR = (8, 6), (16, 12)


def glass() -> np.ndarray:
    """A composite of light 0.5 whose left half was left out."""
    picture = np.zeros((6, 8, 4), np.float32)
    picture[:, 4:] = (0.5, 0.5, 0.5, 1)
    return picture


@pytest.mark.parametrize("placement", [None, Placement(right=0.25)])
def test_backdrop_stands_around_the_glass(placement: Placement | None) -> None:
    ramp = np.repeat(np.linspace(0, 1, 16, dtype=np.float32)[np.newaxis, :, np.newaxis], 12, axis=0)
    found = put_around(glass(), Backdrop(ramp), Window(0, 0, *FRAME), FRAME, MONITOR, placement, 1)
    assert (found[..., 3] == 1).all()
    behind = ramp[0, :, 0].reshape(8, 2).mean(axis=1)
    if placement:
        behind = np.concatenate([[0, 0], behind[:6]])
    np.testing.assert_allclose(found[:, :4, 0], np.tile(behind[:4], (6, 1)), atol=0.02)
    np.testing.assert_allclose(found[:, 4, 0], (2 * 0.5 + behind[4]) / 3, atol=0.02)  # mixed at the edge
    np.testing.assert_array_equal(found[:, 5:, :3], np.float32(0.5))


def test_crop_is_part_of_the_whole() -> None:
    noise = Backdrop(np.random.default_rng(1).random((12, 16, 3), np.float32))
    whole = put_around(glass(), noise, Window(0, 0, *FRAME), FRAME, MONITOR, None, 1)
    window = Window(1, 2, 3, 4)
    crop = np.ascontiguousarray(glass()[2:6, 1:4])
    np.testing.assert_array_equal(put_around(crop, noise, window, FRAME, MONITOR, None, 1), whole[2:6, 1:4])


def test_whole_glass_is_left_as_it_is() -> None:
    picture = np.ones((6, 8, 4), np.float32)
    nothing = Backdrop(np.zeros((2, 2, 3), np.float32))
    assert put_around(picture, nothing, Window(0, 0, *FRAME), FRAME, MONITOR, None, 1) is picture
