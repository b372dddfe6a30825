"""Composites against the dense formula, C = S + rho T L."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from storage import mattes
from storage.errors import Corrupt
from storage.mattes import Block, Matte
from storage.objects import Objects
from workflows.composite import composite
from workflows.grids import area_mean

HEIGHT, WIDTH, COLUMNS, ROWS = 20, 35, 6, 4

Dense = tuple[Matte, NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]


@pytest.fixture
def dense(objects: Objects) -> Dense:
    """A random matte, and its S, rho, T (y, x, channel, cell) and recovered as whole arrays."""
    rng = np.random.default_rng(0)
    S, rho = rng.random((2, HEIGHT, WIDTH, 3), np.float32)
    T = rng.random((HEIGHT, WIDTH, 3, ROWS * COLUMNS), np.float32)
    T *= rng.random(T.shape) < 0.2
    recovered = rng.random((HEIGHT, WIDTH)) < 0.8
    for whole in (S, rho, T):
        whole[~recovered] = 0
    matte = mattes.create(objects, "m", height=HEIGHT, width=WIDTH, columns=COLUMNS, rows=ROWS)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            at = matte.span(row, column)
            count = np.count_nonzero(T[at], axis=3).astype(np.uint32)
            cell = np.nonzero(T[at])[3].astype(np.uint32)
            weight = T[at][np.nonzero(T[at])]
            matte.write(row, column, Block(S[at], rho[at], recovered[at], count, cell, weight))
    return matte, S, rho, T, recovered


@pytest.mark.parametrize("size", [(ROWS, COLUMNS), (9, 7), (2, 3), (1, 1), (40, 60)])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_composite_is_the_formula(dense: Dense, size: tuple[int, int], channels: int) -> None:
    matte, S, rho, T, recovered = dense
    backdrop = np.random.default_rng(1).random((*size, channels), np.float32)
    cells = area_mean(backdrop, COLUMNS, ROWS).reshape(-1, channels)
    light = np.broadcast_to(cells, (len(cells), 3))
    expected = S + rho * np.einsum("yxcl,lc->yxc", T.astype(np.float64), light)
    got = composite(matte, backdrop)
    assert got.dtype == np.float32
    assert got.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_allclose(got[..., :3], expected, atol=1e-5)
    np.testing.assert_array_equal(got[..., 3], recovered)


def test_a_grey_backdrop_is_one_of_three_like_channels(dense: Dense) -> None:
    grey = np.random.default_rng(2).random((11, 13, 1), np.float32)
    np.testing.assert_array_equal(composite(dense[0], grey), composite(dense[0], grey.repeat(3, axis=2)))


def test_cells_are_taken_from_the_top_left(dense: Dense) -> None:
    matte, S, rho, T, _ = dense
    backdrop = np.zeros((ROWS, COLUMNS, 3), np.float32)
    backdrop[1, 4, 2] = 1
    expected = S.copy()
    expected[..., 2] += rho[..., 2] * T[..., 2, 1 * COLUMNS + 4]
    np.testing.assert_allclose(composite(matte, backdrop)[..., :3], expected, atol=1e-6)


@pytest.mark.parametrize("file", ["S/c/1/2/0", "T/1.2/weight/c/0"])
def test_a_missing_block_is_corrupt(dense: Dense, folder: Path, objects: Objects, file: str) -> None:
    (folder / "mattes/m" / file).unlink()
    with pytest.raises(Corrupt):
        composite(Matte(objects, "m"), np.ones((4, 6, 3), np.float32))
