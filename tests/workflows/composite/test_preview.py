"""Previews: enlarged by linear interpolation, and shown where blocks are not done."""

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.composite.engine import Window
from workflows.composite.preview import enlarge, put_behind, window_of_preview

SPACING = 5
WIDTH, HEIGHT = 42, 33
"""Of the frame."""
SMALL = len(range(SPACING // 2, WIDTH, SPACING)), len(range(SPACING // 2, HEIGHT, SPACING))
"""Columns and rows of the preview."""


def ramp(y: NDArray[np.floating], x: NDArray[np.floating]) -> NDArray[np.float32]:
    light = [0.1 + 0.01 * x + 0 * y, 0.2 + 0.02 * y + 0 * x, 0.3 + 0.01 * y - 0.005 * x, 1 + 0 * (x + y)]
    return np.stack(np.broadcast_arrays(*light), axis=-1).astype(np.float32)


def enlarged(preview: NDArray[np.float32], window: Window) -> NDArray[np.float32]:
    part = window_of_preview(window, SPACING, *SMALL)
    small = preview[part.y : part.y + part.height, part.x : part.x + part.width]
    return enlarge(small, part, window, SPACING, *SMALL)


@pytest.mark.parametrize(
    "window",
    [Window(0, 0, WIDTH, HEIGHT), Window(7, 12, 1, 1), Window(40, 0, 2, HEIGHT), Window(3, 4, 17, 9)],
)
def test_enlarged_preview_is_interpolated(window: Window) -> None:
    y, x = (np.arange(SPACING // 2, size, SPACING)[:, np.newaxis] for size in (HEIGHT, WIDTH))
    preview = ramp(y, x.T)
    assert preview.shape == (*SMALL[::-1], 4)
    # Beyond its first and last pixels the preview does not change.
    rows = np.clip(np.arange(window.y, window.y + window.height), y[0], y[-1])[:, np.newaxis]
    columns = np.clip(np.arange(window.x, window.x + window.width), x[0], x[-1])
    np.testing.assert_allclose(enlarged(preview, window), ramp(rows, columns), atol=1e-6)


def test_light_of_pixels_that_are_left_out_is_not_mixed_in() -> None:
    preview = np.zeros((*SMALL[::-1], 4), np.float32)
    preview[:, : SMALL[0] // 2] = [0.2, 0.4, 0.6, 1]
    picture = enlarged(preview, Window(0, 0, WIDTH, HEIGHT))
    there = picture[..., 3] > 0
    edge = SPACING // 2 + SPACING * (SMALL[0] // 2) - SPACING / 2
    np.testing.assert_array_equal(there, np.broadcast_to(np.arange(WIDTH) < edge, there.shape))
    np.testing.assert_allclose(picture[there], np.full((there.sum(), 4), [0.2, 0.4, 0.6, 1]), atol=1e-6)
    assert not picture[~there].any()


def test_blocks_that_are_done_are_not_covered() -> None:
    window = Window(10, 3, 30, 30)
    picture, behind = np.zeros((30, 30, 4), np.float32), np.ones((30, 30, 4), np.float32)
    put_behind(picture, behind, window, {(0, 0), (1, 1), (0, 2), (9, 9)}, 16)
    rows, columns = np.arange(3, 33)[:, np.newaxis] // 16, np.arange(10, 40) // 16
    done = ((rows == 0) & (columns != 1)) | ((rows == 1) & (columns == 1))
    np.testing.assert_array_equal(picture[..., 0] == 0, done)
