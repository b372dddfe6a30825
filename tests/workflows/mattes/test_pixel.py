"""Pixels looked into: of three rows, of one, and of none."""

import tracemalloc

import numpy as np
import pytest

from storage.errors import InvalidInput
from storage.layout import mattes
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from workflows.mattes.pixel import Pixel, contribution, look_into
from workflows.mattes.pixel_picture import picture

NODES = np.array([1, 2, 5, 6 * 40 + 1, 7], np.uint32)
WEIGHTS = np.array([0.25, 0.75, 1, 1, 1], np.float32)


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """A row of four pixels: shared, not shared (with a node of the second grid), empty, left out."""
    made = mattes.create(
        objects, "m", height=1, width=4, columns=40, rows=6, monitor=[80, 60], crosstalk=np.eye(3).tolist()
    )
    count = np.array([[[2, 0, 0], [1, 1, 1], [0, 0, 0], [0, 0, 0]]], np.uint32)
    recovered = np.array([[True, True, True, False]])
    values = np.ones((1, 4, 3), np.float32)
    shared = np.array([[True, False, False, False]])
    made.write(0, 0, Block(values, values, values[..., 0], recovered, shared, count, NODES, WEIGHTS))
    return made


def test_cells_are_heaviest_first_with_a_weight_for_each_channel(matte: Matte) -> None:
    shared, apart = (look_into(matte, x, 0, 4) for x in (0, 1))
    assert shared.node.tolist() == [2, 1]
    np.testing.assert_array_equal(shared.weight, [[0.75] * 3, [0.25] * 3])
    np.testing.assert_allclose(shared.cells[0], [2.5 / 40, 1 - 0.5 / 6, 1 / 40, 1 / 6])
    assert apart.node.tolist() == [5, 7, 241]
    np.testing.assert_array_equal(apart.weight, [[1, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert apart.levels.tolist() == [0, 0, 1]
    np.testing.assert_allclose(apart.cells[2, [0, 2]], [3 / 40, 2 / 40])


def test_contributions_are_those_of_the_bumps(matte: Matte) -> None:
    shared, apart = (contribution(look_into(matte, x, 0, 4), (0, 0, 1, 1), 40, 6) for x in (0, 1))
    np.testing.assert_allclose(shared[0, :4, 1], [0, 0.25, 0.75, 0], atol=1e-12)
    np.testing.assert_allclose(apart.sum(axis=(0, 1)), 1)
    np.testing.assert_allclose(apart[:, :, 1].sum(axis=0)[:6], np.array([0, 1, 3, 3, 1, 0]) / 8, atol=1e-12)
    # a part of the monitor, in other places
    part = contribution(look_into(matte, 0, 0, 4), (0, 0, 0.1, 1), 8, 1)
    np.testing.assert_allclose(part[0, :, 0], [0, 0, 0.125, 0.125, 0.375, 0.375, 0, 0], atol=1e-12)


@pytest.mark.parametrize(("x", "recovered"), [(2, True), (3, False)])
def test_pixel_without_transport_is_drawn_empty(matte: Matte, x: int, recovered: bool) -> None:
    pixel = look_into(matte, x, 0, 4)
    assert (pixel.recovered, len(pixel.node), len(pixel.cells), len(pixel.lobes)) == (recovered, 0, 0, 0)
    assert picture(pixel).startswith(b"\x89PNG")


@pytest.mark.parametrize(("x", "y"), [(4, 0), (-1, 0), (0, 1)])
def test_pixel_outside_the_frame_is_refused(matte: Matte, x: int, y: int) -> None:
    with pytest.raises(InvalidInput, match="from 0 to"):
        look_into(matte, x, y, 4)


def test_drawing_many_cells_of_a_fine_grid_takes_little_memory() -> None:
    side, n = 16384, 20_000
    node = np.arange(n) * (side * side // n)
    weight = np.full((n, 3), 1 / n, np.float32)
    none = np.zeros(3, np.float32)
    pixel = Pixel(
        0, 0, (side, side), side, side, True, none, none, node, weight, np.zeros((0, 8), np.float32)
    )
    tracemalloc.start()
    try:
        shares = contribution(pixel, (0, 0, 1, 1), 492, 492)
        assert tracemalloc.get_traced_memory()[1] < 100e6  # each cell and column by itself: 2.6 GB
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(shares.sum(axis=(0, 1)), 1, atol=1e-5)
