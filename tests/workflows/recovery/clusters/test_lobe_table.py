"""Lobes by hand: the moments of bumps, mixtures that are known, their ranks and their merging."""

import time

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.recovery.clusters.lobe_table import FIELDS, ranked_lobes
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.transport import Transport

COLUMNS, ROWS = 75, 40
PYRAMID = Pyramid.over(COLUMNS, ROWS)


def transport(*pixels: list[dict[int, float]]) -> Transport:
    """Rows by pixel: of one channel, which all share, or of three."""
    rows = [row for pixel in pixels for row in pixel + [{}] * (3 - len(pixel))]
    return Transport(
        COLUMNS,
        ROWS,
        np.array([len(row) for row in rows], np.uint32).reshape(-1, 3),
        np.array([cell for row in rows for cell in sorted(row)], np.uint32),
        np.array([row[cell] for row in rows for cell in sorted(row)], np.float32),
        np.array([len(pixel) == 1 for pixel in pixels]),
    )


def lobes(*pixels: list[dict[int, float]], most: int = 4, aspect: float = ROWS / COLUMNS) -> NDArray:
    found = ranked_lobes(transport(*pixels), most, aspect)
    assert found.dtype == np.float32
    assert found.shape == (len(pixels), most, len(FIELDS))
    return found.astype(np.float64)


def gaussian(x: float, y: float, major: float, minor: float, turn: float, share: float) -> dict[int, float]:
    """Cells under a Gaussian, in cells from the bottom left, counter-clockwise."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    dx, dy = column + 0.5 - x, ROWS - row - 0.5 - y
    along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
    density = np.exp(-((along / major) ** 2 + (across / minor) ** 2) / 2)
    density[density < 1e-4] = 0
    density *= share / density.sum()
    return {int(cell): density.flat[cell] for cell in np.flatnonzero(density)}


@pytest.mark.parametrize("level", range(len(PYRAMID.grids)))
def test_a_node_is_a_lobe_with_the_moments_of_its_bump(level: int) -> None:
    columns, rows = PYRAMID.grids[level]
    for row, column in ((0, 0), (rows // 2, columns // 2), (rows - 1, columns - 1), (rows // 2, 0)):
        node = int(PYRAMID.starts[level]) + row * columns + column
        # what the node sees of light in one cell is the cell's share of its bump
        ones = np.eye(COLUMNS, dtype=np.float32)[np.newaxis].repeat(ROWS, 0)
        across = PYRAMID.light(ones)[node].astype(np.float64)
        ones = np.eye(ROWS, dtype=np.float32)[:, np.newaxis].repeat(COLUMNS, 1)
        down = PYRAMID.light(np.ascontiguousarray(ones))[node].astype(np.float64)
        x, y = np.arange(COLUMNS) + 0.5, ROWS - np.arange(ROWS) - 0.5
        u, v = across @ x, down @ y
        sides = np.sqrt([across @ (x - u) ** 2 + 1 / 12, down @ (y - v) ** 2 + 1 / 12])
        found = lobes([{node: 1.0}])[0]
        np.testing.assert_allclose(found[0, :2], [u / COLUMNS, v / ROWS], rtol=1e-5)
        np.testing.assert_allclose(found[0, 5:7], sides / COLUMNS, rtol=1e-4)
        np.testing.assert_array_equal(found[0, [2, 3, 4, 7]], [1, 1, 1, 0])
        assert not found[1:].any()


def test_a_cell_of_a_monitor_with_oblong_cells_is_measured_in_widths_of_the_monitor() -> None:
    found = lobes([{5 * COLUMNS + 7: 1.0}], aspect=0.75)[0, 0]
    np.testing.assert_allclose(found[:2], [7.5 / COLUMNS, 1 - 5.5 / ROWS], rtol=1e-6)
    np.testing.assert_allclose(found[5:7], np.array([1 / COLUMNS, 0.75 / ROWS]) / np.sqrt(12), rtol=1e-5)


@pytest.mark.parametrize("turn", [0.0, 0.6, -0.6, 1.2, -1.2, np.pi / 2])
def test_a_gaussian_is_one_lobe_that_lies_as_it_does(turn: float) -> None:
    found = lobes([gaussian(30.3, 18.2, 4.0, 2.0, turn, 1.0)])[0]
    assert not found[1:].any()
    u, v, *weight, sigma_u, sigma_v, theta = found[0]
    np.testing.assert_allclose([u * COLUMNS, v * ROWS], [30.3, 18.2], atol=0.02)
    np.testing.assert_allclose(weight, 1, atol=1e-6)
    assert abs(theta) <= np.pi / 4 + 1e-6
    # the covariance, from the described ellipse
    axes = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    got = axes @ np.diag([sigma_u**2, sigma_v**2]) @ axes.T * COLUMNS**2
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    np.testing.assert_allclose(got, axes @ np.diag([16.0, 4.0]) @ axes.T, atol=0.4)


def test_lobes_that_are_apart_stay_apart_heaviest_first() -> None:
    parts = [gaussian(12, 10, 2, 1.5, 0.3, 0.25), gaussian(55, 30, 1.5, 1.5, 0, 0.7)]
    single = {20 * COLUMNS + 40: 0.05}
    found = lobes([parts[0] | parts[1] | single])[0]
    np.testing.assert_allclose(found[:, 2], [0.7, 0.25, 0.05, 0], atol=1e-3)
    np.testing.assert_allclose(found[:3, 0] * COLUMNS, [55, 12, 40.5], atol=0.05)
    np.testing.assert_allclose(found[:3, 1] * ROWS, [30, 10, ROWS - 20.5], atol=0.05)


def test_a_sharp_lobe_on_a_broad_one_is_another() -> None:
    coarse = int(PYRAMID.starts[2]) + 5 * PYRAMID.grids[2][0] + 9
    at = PYRAMID.axis_moments(0)[sum(columns for columns, _ in PYRAMID.grids[:2]) + 9, 0]
    found = lobes([{20 * COLUMNS + int(at): 0.4, coarse: 0.6}])[0]
    np.testing.assert_allclose(found[:, 2], [0.6, 0.4, 0, 0], atol=1e-6)
    assert found[0, 5] > 3 * found[1, 5]


def test_more_than_there_is_room_for_merge_and_lose_no_light() -> None:
    cells = {(3 + 6 * n) * COLUMNS + 5 + 11 * n: 0.1 + 0.02 * n for n in range(6)}
    whole = {cell: weight / sum(cells.values()) for cell, weight in cells.items()}
    for most in (1, 2, 4, 8):
        found = lobes([whole], most=most)[0]
        np.testing.assert_allclose(found[:, 2:5].sum(axis=0), 1, atol=1e-6)
        assert (np.diff(found[:, 2]) <= 0).all()
        assert np.count_nonzero(found[:, 2]) == min(most, 6)
    mean = sum(weight * (cell % COLUMNS + 0.5) for cell, weight in whole.items()) / COLUMNS
    np.testing.assert_allclose(lobes([whole], most=1)[0, 0, 0], mean, rtol=1e-6)


def test_channels_that_come_from_one_place_have_three_weights() -> None:
    near, far = gaussian(20, 12, 2, 2, 0, 1.0), gaussian(60, 30, 2, 2, 0, 0.7)
    green = gaussian(20.2, 12, 2, 2, 0, 1.0)
    found = lobes([near, green, gaussian(20, 12, 2, 2, 0, 0.3) | far])[0]
    np.testing.assert_allclose(found[:2, 2:5], [[1, 1, 0.3], [0, 0, 0.7]], atol=1e-5)
    assert not found[2:].any()
    np.testing.assert_allclose(found[0, 0] * COLUMNS, (1.3 * 20 + 20.2) / 2.3, atol=0.02)


def test_the_fringes_of_a_prism_are_lobes_apart() -> None:
    found = lobes([gaussian(x, 20, 2.5, 1.5, 0, 1.0) for x in (27, 30, 33)])[0]
    # each colour keeps its place, as far as four lobes allow
    centres = found[:, 2:5].T @ found[:, 0] * COLUMNS
    np.testing.assert_allclose(centres, [27, 30, 33], atol=0.4)


def test_pixels_do_not_depend_on_each_other() -> None:
    pixels = [
        [gaussian(20, 12, 5, 3, 0.4, 1.0)],
        [{}],
        [gaussian(30, 12, 2, 2, 0, 1.0), gaussian(33, 12, 2, 2, 0, 1.0), {5: 1.0}],
        [{7: 1.0}],
    ]
    together = lobes(*pixels)
    assert not together[1].any()
    for n, pixel in enumerate(pixels):
        np.testing.assert_array_equal(together[n], lobes(pixel)[0])


@pytest.mark.parametrize(("most", "aspect"), [(0, 1.0), (4, 0.0)])
def test_ranked_lobes_needs_a_positive_number_and_aspect(most: int, aspect: float) -> None:
    with pytest.raises(ValueError, match="at least 1 and aspect positive"):
        ranked_lobes(transport([{0: 1.0}]), most, aspect)


def test_pixel_that_sees_thousands_of_places_takes_milliseconds() -> None:
    """Every colour sees cells of its own, far from those of the others, so none of them may merge as near."""
    side = 240
    cells = np.arange(side * side).reshape(-1, 3).T  # of a quarter of the columns and rows below
    at = np.sort((cells // side) * 4 * 960 + cells % side * 4, axis=1).astype(np.uint32)
    count = np.full((1, 3), at.shape[1], np.uint32)
    pixel = Transport(
        960, 960, count, at.ravel(), np.full(at.size, 1 / at.shape[1], np.float32), np.zeros(1, bool)
    )
    lobes([{0: 1.0}])  # compiles the kernel
    start = time.perf_counter()
    found = ranked_lobes(pixel, 4, 1.0)[0]
    assert time.perf_counter() - start < 5  # without a bound, longer than a day
    np.testing.assert_allclose(found[:, 2:5].sum(axis=0), 1, atol=1e-4)
    np.testing.assert_allclose(found[:, 0] @ found[:, 2:5].mean(axis=1), 0.5, atol=0.01)


def test_work_ends_between_pixels() -> None:
    calls = 0

    def end() -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        ranked_lobes(transport(*[[{0: 1.0}]] * 1000), 4, 1.0, end)
    assert calls == 3
