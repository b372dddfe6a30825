"""Composites against the dense formula, C = S + X (rho T L)."""

from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.errors import Corrupt, OptionError
from storage.layout import mattes
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from workflows.composite import composite, engine, light_on
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.engine import Window
from workflows.composite.interval import contrast_on, half_widths
from workflows.composite.strips import read_strip
from workflows.images.resample import area_mean
from workflows.mattes.layers import confidence
from workflows.recovery.interval import Interval, local_contrast
from workflows.recovery.pyramid import Pyramid

HEIGHT, WIDTH, COLUMNS, ROWS = 20, 35, 36, 5
CROSSTALK = [[0.9, 0.1, 0], [0.05, 0.8, 0.15], [0.02, 0.18, 0.8]]
ERROR = np.linspace(0, 0.1, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
ERROR[0, :4] = np.inf
# Of a second grid, 18 x 3.
NODES = COLUMNS * ROWS + 18 * 3

Dense = tuple[Matte, NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]


@pytest.fixture
def dense(objects: Objects) -> Dense:
    """A random matte, and its S, rho, T (y, x, channel, cell) and recovered as whole arrays.

    In some pixels the first row is the T of all channels.
    """
    rng = np.random.default_rng(0)
    S, rho = rng.random((2, HEIGHT, WIDTH, 3), np.float32)
    T = rng.random((HEIGHT, WIDTH, 3, NODES), np.float32)
    T *= rng.random(T.shape) < 0.05
    recovered = rng.random((HEIGHT, WIDTH)) < 0.8
    for whole in (S, rho, T):
        whole[~recovered] = 0
    shared = recovered & (rng.random((HEIGHT, WIDTH)) < 0.5)
    stored = T.copy()
    stored[shared, 1:] = 0
    T[shared] = T[shared][:, :1]
    matte = mattes.create(
        objects,
        "m",
        height=HEIGHT,
        width=WIDTH,
        columns=COLUMNS,
        rows=ROWS,
        crosstalk=CROSSTALK,
        monitor=[COLUMNS, ROWS],
    )
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            at = matte.span(row, column)
            count = np.count_nonzero(stored[at], axis=3).astype(np.uint32)
            cell = np.nonzero(stored[at])[3].astype(np.uint32)
            weight = stored[at][np.nonzero(stored[at])]
            block = Block(S[at], rho[at], ERROR[at], recovered[at], shared[at], count, cell, weight)
            matte.write(row, column, block)
    return matte, S, rho, T, recovered


def nodes(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """The light of the nodes of both grids, as the layout in storage/layout/mattes.py says."""
    coarse = np.zeros((3, 18, cells.shape[2]), np.float32)
    for y, x, i, j in product(range(3), range(18), range(4), range(4)):
        row, column = np.clip([2 * y - 1 + i, 2 * x - 1 + j], 0, [ROWS - 1, COLUMNS - 1])
        coarse[y, x] += cells[row, column] * (1, 3, 3, 1)[i] * (1, 3, 3, 1)[j] / 64
    return np.concatenate([cells.reshape(-1, cells.shape[2]), coarse.reshape(-1, cells.shape[2])])


@pytest.mark.parametrize("size", [(ROWS, COLUMNS), (9, 7), (2, 3), (1, 1), (40, 60)])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_composite_is_the_formula(dense: Dense, size: tuple[int, int], channels: int) -> None:
    matte, S, rho, T, recovered = dense
    backdrop = np.random.default_rng(1).random((*size, channels), np.float32)
    light = np.broadcast_to(nodes(area_mean(backdrop, COLUMNS, ROWS)), (NODES, 3))
    expected = S + (rho * np.einsum("yxcl,lc->yxc", T.astype(np.float64), light)) @ np.transpose(CROSSTALK)
    got = composite(matte, backdrop)
    assert got.dtype == np.float32
    assert got.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_allclose(got[..., :3], expected, atol=3e-5)
    np.testing.assert_array_equal(got[..., 3], recovered)


def test_a_grey_backdrop_is_one_of_three_like_channels(dense: Dense) -> None:
    grey = np.random.default_rng(2).random((11, 13, 1), np.float32)
    np.testing.assert_array_equal(composite(dense[0], grey), composite(dense[0], grey.repeat(3, axis=2)))


def test_cells_are_taken_from_the_top_left(dense: Dense) -> None:
    matte, S, rho, T, _ = dense
    backdrop = np.zeros((ROWS, COLUMNS, 3), np.float32)
    backdrop[1, 4, 2] = 1
    # column 4 of row 1 is in the bumps of columns 1 and 2 and of rows 0 and 1
    share = np.zeros(NODES)
    share[1 * COLUMNS + 4] = 1
    for row, column, weight in ((0, 1, 3), (0, 2, 9), (1, 1, 1), (1, 2, 3)):
        share[COLUMNS * ROWS + row * 18 + column] = weight / 64
    arrived = rho[..., 2] * (T[..., 2, :] @ share)
    expected = S + arrived[..., np.newaxis] * np.array(CROSSTALK)[:, 2]
    np.testing.assert_allclose(composite(matte, backdrop)[..., :3], expected, atol=1e-5)


@pytest.mark.parametrize(
    "crop", [(0, 0, 35, 20), (3, 4, 1, 1), (15, 15, 4, 3), (16, 16, 19, 4), (0, 19, 35, 1)]
)
def test_a_window_is_a_piece_of_the_whole(dense: Dense, crop: tuple[int, int, int, int]) -> None:
    backdrop = np.random.default_rng(3).random((9, 7, 3), np.float32)
    whole = composite(dense[0], backdrop)
    x, y, width, height = crop
    for threads in (1, 3):
        window = Window.of(dense[0], x, y, width, height)
        seen = composite(dense[0], backdrop, window=window, threads=threads)
        np.testing.assert_array_equal(seen, whole[y : y + height, x : x + width])


def test_bands_make_up_the_window_and_are_cut_between_blocks(
    dense: Dense, monkeypatch: pytest.MonkeyPatch
) -> None:
    matte = dense[0]
    backdrop = np.random.default_rng(1).random((ROWS, COLUMNS, 3), np.float32)
    window = Window(3, 2, 30, 17)
    whole = composite(matte, backdrop, window=window)
    assert window.bands(matte.block) == [window]
    monkeypatch.setattr(engine, "BAND", 30 * 5)
    bands = window.bands(4)
    assert [(band.y, band.height) for band in bands] == [(2, 2), (4, 4), (8, 4), (12, 4), (16, 3)]
    assert np.array_equal(np.concatenate([composite(matte, backdrop, window=band) for band in bands]), whole)


@pytest.mark.parametrize(
    ("crop", "field"),
    [((35, 0, 1, 1), "x"), ((0, 15, 1, 6), "y"), ((0, 0, 36, 1), "x"), ((0, -1, 1, 1), "y")],
)
def test_a_window_lies_in_the_matte(dense: Dense, crop: tuple[int, int, int, int], field: str) -> None:
    with pytest.raises(OptionError, match="35 x 20") as caught:
        Window.of(dense[0], *crop)
    assert caught.value.fields["field"] == field


def test_a_window_beyond_the_matte_is_of_no_length(dense: Dense) -> None:
    with pytest.raises(OptionError, match="a crop from x = 40 does not lie inside"):
        Window.of(dense[0], x=40)


def test_blocks_not_yet_recovered_are_left_out(dense: Dense) -> None:
    matte, *_ = dense
    backdrop = np.ones((4, 6, 3), np.float32)
    there = {(0, 0), (1, 2)}
    seen = composite(matte, backdrop, read=lambda row, number: read_strip(matte, row, number, there))
    whole = composite(matte, backdrop)
    for row, column in product(range(2), range(3)):
        at = matte.span(row, column)
        np.testing.assert_array_equal(seen[at], whole[at] if (row, column) in there else 0)


@pytest.mark.parametrize("file", ["S/c/1/2/0", "T/1.2/weight/c/0"])
def test_a_missing_block_is_corrupt(dense: Dense, folder: Path, objects: Objects, file: str) -> None:
    (folder / "mattes/m" / file).unlink()
    with pytest.raises(Corrupt):
        composite(Matte(objects, "m"), np.ones((4, 6, 3), np.float32))


def test_half_an_interval_is_the_formula(dense: Dense) -> None:
    matte, S, rho, T, recovered = dense
    backdrop = np.random.default_rng(2).random((2 * ROWS, 3 * COLUMNS, 3), np.float32)
    mean, square = (area_mean(part, COLUMNS, ROWS) for part in (backdrop, backdrop**2))
    W = local_contrast(Pyramid.over(COLUMNS, ROWS), nodes(mean), nodes(square))

    def arrived(light: NDArray[np.float32]) -> NDArray[np.float64]:
        return (rho * np.einsum("yxcl,lc->yxc", T.astype(np.float64), light)) @ np.transpose(CROSSTALK)

    C, white = S + arrived(nodes(mean)), arrived(np.ones((NODES, 3), np.float32))
    variance = 0.3 * (white * arrived(W)) ** 0.75 + 1e-4 + 2e-3 * C + 0.01 * white**2
    light = light_on(matte, Backdrop(backdrop), None, 1)
    contrast = contrast_on(matte, light, Backdrop(backdrop.copy()), None, 1)
    interval = Interval(contrast=0.3, read=1e-4, shot=2e-3, share=0.01)
    window = Window(3, 2, 20, 15)
    got = half_widths(matte, interval, light, contrast, window, partial(read_strip, matte), 1)
    inside = np.s_[2:17, 3:23]
    np.testing.assert_allclose(
        got[..., :3][recovered[inside]], 1.6449 * np.sqrt(variance[inside][recovered[inside]]), rtol=1e-3
    )
    np.testing.assert_array_equal(got[..., 3], recovered[inside])


def test_confidence_is_a_half_where_an_error_of_a_hundredth_is_expected(dense: Dense) -> None:
    matte, *_, recovered = dense
    trusted = confidence(matte)
    assert trusted.dtype == np.float32
    assert (trusted[0, :4] == 0).all()
    assert (trusted[~recovered] == 0).all()
    seen = recovered & np.isfinite(ERROR)
    np.testing.assert_allclose(trusted[seen], 0.01 / (0.01 + ERROR[seen]), rtol=1e-5)
