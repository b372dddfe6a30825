"""Blocks side by side in one piece."""

from pathlib import Path

import numpy as np
import pytest

from storage.layout import mattes
from storage.layout.mattes import Block, Matte, empty_block
from storage.objects.store import Objects
from workflows.composite import composite
from workflows.composite.engine import Window
from workflows.composite.strips import LENGTH, columns_of, read_strip

HEIGHT, WIDTH = 20, LENGTH + 21


@pytest.fixture
def wide(tmp_path: Path) -> Matte:
    """Two strips wide, of random rows T."""
    columns, rows = 40, 30
    objects = Objects((tmp_path / "store").as_uri())
    matte = mattes.create(
        objects, "m", height=HEIGHT, width=WIDTH, columns=columns, rows=rows, crosstalk=np.eye(3).tolist()
    )
    rng = np.random.default_rng(0)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            h, w = (span.stop - span.start for span in matte.span(row, column))
            count = rng.integers(0, 5, (h, w, 3), np.uint32)
            shared = rng.random((h, w)) < 0.5
            count[shared, 1:] = 0
            n = int(count.sum())
            cell = rng.integers(0, columns * rows, n, np.uint32)
            S, rho = rng.random((2, h, w, 3), np.float32)
            recovered = rng.random((h, w)) < 0.9
            weight = rng.random(n, np.float32)
            matte.write(row, column, Block(S, rho, S[..., 0], recovered, shared, count, cell, weight))
    return matte


def test_strips_in_which_nothing_is_recovered_take_no_memory_each(wide: Matte) -> None:
    for column in columns_of(wide, 0):
        for row in range(wide.block_rows):
            height, width = (span.stop - span.start for span in wide.span(row, column))
            wide.write(row, column, empty_block(height, width))
    first, again = read_strip(wide, 0, 0), read_strip(wide, 0, 0)
    assert (first.recovered.shape, first.nbytes) == ((16, LENGTH), 0)
    assert first.S is again.S
    assert read_strip(wide, 0, 1).nbytes > 0
    assert not composite(wide, np.ones((3, 4, 3), np.float32), window=Window.of(wide, width=LENGTH)).any()


def test_a_strip_has_the_rows_of_its_blocks(wide: Matte) -> None:
    for row in range(wide.block_rows):
        for number in range(2):
            strip = read_strip(wide, row, number)
            rows = np.split(
                np.stack([strip.cell, strip.weight]), strip.count.sum(axis=2).cumsum()[:-1], axis=1
            )
            across = strip.S.shape[1]
            for column in columns_of(wide, number):
                block = wide.read(row, column)
                own = np.split(
                    np.stack([block.cell, block.weight]), block.count.sum(axis=2).cumsum()[:-1], axis=1
                )
                left = column * wide.block - number * LENGTH
                h, w = block.shared.shape
                for name in ("S", "rho", "recovered", "shared", "count"):
                    np.testing.assert_array_equal(
                        getattr(strip, name)[:, left : left + w], getattr(block, name)
                    )
                for y in range(h):
                    for x in range(w):
                        np.testing.assert_array_equal(rows[y * across + left + x], own[y * w + x])


def test_a_window_over_two_strips_is_a_piece_of_the_whole(wide: Matte) -> None:
    backdrop = np.random.default_rng(1).random((30, 40, 3), np.float32)
    whole = composite(wide, backdrop, threads=1)
    assert whole[..., :3].std() > 0.1
    for x, width in ((0, WIDTH), (LENGTH - 3, 8), (LENGTH, 5), (5, LENGTH)):
        seen = composite(wide, backdrop, window=Window.of(wide, x, 9, width, 10), threads=2)
        np.testing.assert_array_equal(seen, whole[9:19, x : x + width])
