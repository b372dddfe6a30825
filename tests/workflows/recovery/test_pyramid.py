"""The pyramid of bumps against a dense convolution, and its whole-number form against both."""

from itertools import pairwise

import numpy as np
import pytest

from workflows.recovery.pyramid import Pyramid, halve_codes

SIZES = [(80, 64), (67, 33), (33, 70), (41, 1), (1, 65)]


def dense(n):
    """One step along an axis as a matrix: [1, 3, 3, 1] / 8 about every second pair of places, the edge beyond it."""
    step = np.zeros((-(-n // 2), n))
    for i in range(len(step)):
        for k, weight in enumerate((1, 3, 3, 1)):
            step[i, min(max(2 * i - 1 + k, 0), n - 1)] += weight / 8
    return step


@pytest.mark.parametrize(("columns", "rows"), SIZES)
def test_light_is_the_convolution(columns, rows):
    image = np.random.default_rng(0).random((rows, columns, 3), np.float32)
    pyramid = Pyramid.over(columns, rows)
    light = pyramid.light(image)
    assert light.shape == (pyramid.nodes, 3)
    assert light.dtype == np.float32
    expected = image.astype(float)
    for (wide, high), (first, last) in zip(pyramid.grids, pairwise(pyramid.starts), strict=True):
        assert expected.shape == (high, wide, 3)
        np.testing.assert_allclose(light[first:last], expected.reshape(-1, 3), atol=1e-6)
        expected = np.einsum("yv,xu,vuc->yxc", dense(high), dense(wide), expected)


@pytest.mark.parametrize(("columns", "rows"), SIZES)
def test_codes_are_the_light_but_for_rounding(columns, rows):
    codes = np.random.default_rng(1).integers(0, 256, (rows, columns, 5), np.uint8)
    pyramid = Pyramid.over(columns, rows)
    fine, exact = codes.reshape(-1, 5), pyramid.light(codes.astype(np.float32))
    for level, (wide, high) in enumerate(pyramid.grids[:-1]):
        first, last = pyramid.starts[level + 1 : level + 3]
        coarse = np.empty((last - first, 5), np.uint8)
        halve_codes(fine, wide, high, coarse, np.empty(5, np.uint16))
        of_codes = Pyramid(pyramid.grids[level : level + 2]).light(
            fine.reshape(high, wide, 5).astype(np.float32)
        )[wide * high :]
        np.testing.assert_array_equal(coarse, np.floor(of_codes + 0.5))
        assert np.abs(coarse - exact[first:last]).max() <= 0.5 * (level + 1)
        fine = coarse


def test_constants_stay_constant():
    pyramid = Pyramid.over(67, 33)
    light = pyramid.light(np.full((33, 67, 1), 0.3, np.float32))
    np.testing.assert_allclose(light, 0.3, rtol=1e-6)
    coarse = np.empty((34 * 17, 256), np.uint8)
    values = np.arange(256, dtype=np.uint8)
    halve_codes(np.tile(values, (33 * 67, 1)), 67, 33, coarse, np.empty(256, np.uint16))
    np.testing.assert_array_equal(coarse, np.tile(values, (34 * 17, 1)))


def test_nodes_are_numbered_grid_by_grid_and_row_by_row():
    pyramid = Pyramid.over(70, 9)
    assert pyramid.grids == ((70, 9), (35, 5), (18, 3))
    assert pyramid.starts.tolist() == [0, 630, 805, 859]
    assert pyramid.nodes == 859
    image = np.zeros((9, 70, 1), np.float32)
    image[5, 20] = 1
    light = pyramid.light(image)[:, 0]
    assert light[5 * 70 + 20] == 1
    # rows 4 and 5, columns 20 and 21 are in the middle of row 2, column 10
    assert light[630 + 2 * 35 + 10] == 9 / 64
    assert light[630 + 3 * 35 + 9] == 1 / 64
    assert np.flatnonzero(light[:805]).size == 5


@pytest.mark.parametrize("size", [(1, 1), (32, 32), (5, 32)])
def test_a_small_grid_is_the_only_one(size):
    assert Pyramid.over(*size).grids == (size,)


def test_light_of_another_grid_is_refused():
    with pytest.raises(ValueError, match=r"\(6, 4\)"):
        Pyramid.over(6, 4).light(np.zeros((6, 4, 1), np.float32))
