"""Images on grids: exact means against a plain integral, the smallest grid that loses nothing, and shifts."""

import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.images.resample import area_mean, shift_back, smallest_grid, stretch, stretched_mean


def test_smallest_grid_loses_no_detail() -> None:
    rng = np.random.default_rng(3)
    small = rng.random((6, 5, 3), np.float32)
    for down, across in ((1, 1), (4, 1), (3, 7)):
        image = small.repeat(down, axis=0).repeat(across, axis=1)
        np.testing.assert_array_equal(smallest_grid(image), small)
    assert smallest_grid(np.full((12, 30, 1), 0.4, np.float32)).shape == (1, 1, 1)
    # Blocks of 5 pixels and 3 lie on no even grid but that of single pixels.
    uneven = np.array([0] * 5 + [1] * 3, np.float32).reshape(1, 8, 1).repeat(4, axis=0)
    np.testing.assert_array_equal(smallest_grid(uneven), uneven[:1])
    # An edge in one channel alone counts.
    one = np.zeros((4, 4, 3), np.float32)
    one[:, 2:, 1] = 1
    assert smallest_grid(one).shape == (1, 2, 3)
    codes = (one * 255).astype(np.uint8)
    assert smallest_grid(codes).dtype == np.uint8
    assert smallest_grid(codes).shape == (1, 2, 3)


def plain_mean(image: NDArray[np.float32], columns: int, rows: int) -> NDArray[np.float64]:
    """The same integral, cell by cell and pixel by pixel."""
    height, width, channels = image.shape
    out = np.zeros((rows, columns, channels))
    for row in range(rows):
        for column in range(columns):
            top, bottom = row * height / rows, (row + 1) * height / rows
            left, right = column * width / columns, (column + 1) * width / columns
            for y in range(height):
                for x in range(width):
                    high = max(0.0, min(bottom, y + 1) - max(top, y))
                    wide = max(0.0, min(right, x + 1) - max(left, x))
                    out[row, column] += high * wide * image[y, x]
            out[row, column] /= (bottom - top) * (right - left)
    return out


@pytest.mark.parametrize(
    ("columns", "rows"), [(1, 1), (2, 3), (4, 3), (8, 6), (7, 5), (13, 11), (3, 9), (16, 2)]
)
@pytest.mark.parametrize("channels", [1, 3])
def test_area_mean_is_the_integral(columns: int, rows: int, channels: int) -> None:
    image = np.random.default_rng(columns).random((6, 8, channels), np.float32)
    got = area_mean(image, columns, rows)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, plain_mean(image, columns, rows), atol=2e-6)


def test_area_mean_keeps_a_constant() -> None:
    for size in ((1, 1), (640, 480), (999, 1)):
        got = area_mean(np.full((37, 41, 3), 0.3, np.float32), *size)
        np.testing.assert_allclose(got, 0.3, rtol=1e-6)


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (3, 2), (8, 6), (5, 5), (11, 9)])
def test_stretching_gives_each_pixel_its_block(columns: int, rows: int) -> None:
    values = np.random.default_rng(0).random((rows, columns, 3), np.float32)
    picture = stretch(values, 8, 6)
    assert picture.shape == (6, 8, 3)
    for y in range(6):
        for x in range(8):
            np.testing.assert_array_equal(picture[y, x], values[y * rows // 6, x * columns // 8])


@pytest.mark.parametrize("offset", [(0, 0), (5, 17)])
@pytest.mark.parametrize(("columns", "rows"), [(20, 15), (10, 8), (7, 5), (40, 30)])
@pytest.mark.parametrize("shape", [(6, 8, 3), (1, 16, 1), (30, 40, 1), (11, 13, 1)])
def test_mean_of_what_is_stretched_and_rolled(
    shape: tuple[int, int, int], columns: int, rows: int, offset: tuple[int, int]
) -> None:
    values = np.random.default_rng(0).integers(0, 2, shape).astype(np.float32)
    rolled = np.roll(stretch(values, 40, 30), (-offset[1], -offset[0]), axis=(0, 1))
    got = stretched_mean(values, (40, 30), columns, rows, offset)
    np.testing.assert_array_equal(got, area_mean(rolled, columns, rows))


def test_a_large_monitor_takes_little_memory() -> None:
    values = np.random.default_rng(0).random((512, 700, 1), np.float32)
    tracemalloc.start()
    try:
        got = stretched_mean(values, (16384, 16384), 1024, 1000, (3, 4))
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()
    assert got.shape == (1000, 1024, 1)
    np.testing.assert_allclose(got.mean(), values.mean(), atol=1e-5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.0), (-1.3, 2.6)])
def test_a_picture_that_moved_is_moved_back(shift: tuple[float, float]) -> None:
    def picture(dx: float, dy: float) -> NDArray[np.float32]:
        y, x = np.mgrid[:40, :50].astype(np.float32)
        value = 120 + 60 * np.sin((x - dx) / 2.5) + 50 * np.cos((y - dy) / 3 + (x - dx) / 9)
        return np.stack([value, value / 2, value], axis=2)

    margin = 6
    moved = shift_back(picture(*shift), shift, margin)
    inside = slice(margin, -margin)
    np.testing.assert_allclose(moved, picture(0, 0)[inside, inside], atol=1)
    # the same in whatever rectangle
    part = shift_back(picture(*shift)[5:30, 7:44], shift, margin)
    np.testing.assert_array_equal(part, moved[5 : 30 - 2 * margin, 7 : 44 - 2 * margin])
