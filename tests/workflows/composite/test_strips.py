"""Blocks side by side in one piece."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from storage.layout import mattes
from storage.layout.mattes import Block, Matte, empty_block
from storage.objects.store import Objects
from workflows.composite import composite
from workflows.composite.engine import Window
from workflows.composite.strips import LENGTH, MOST, Strip, columns_of, read_strip

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
            row_of_entry = np.repeat(np.arange(count.size), count.reshape(-1))
            cell = rng.integers(0, columns * rows, n, np.uint32)
            cell = cell[np.lexsort((cell, row_of_entry))]
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


def rows_of(strip: Strip) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The cells and codes of each pixel."""
    first, entry = iter(strip.first.tolist()), 0
    for counts in strip.count.reshape(-1, 3).tolist():
        cells, begin = [np.zeros(0, int)], entry
        for count in filter(None, counts):
            cells.append(next(first) + np.cumsum(strip.step[entry : entry + count], dtype=int))
            entry += count
        yield np.concatenate(cells), strip.code[begin:entry]


def test_a_strip_has_the_rows_of_its_blocks(wide: Matte) -> None:
    for row in range(wide.block_rows):
        for number in range(2):
            strip = read_strip(wide, row, number)
            rows = list(rows_of(strip))
            across = strip.S.shape[1]
            for column in columns_of(wide, number):
                block = wide.read(row, column)
                left = column * wide.block - number * LENGTH
                h, w = block.shared.shape
                part = slice(left, left + w)
                for name in ("S", "recovered", "shared"):
                    np.testing.assert_array_equal(getattr(strip, name)[:, part], getattr(block, name))
                ends = np.append(0, block.count.cumsum(dtype=int))
                for y, x in np.ndindex(h, w):
                    at = 3 * (y * w + x)
                    cell, code = rows[y * across + left + x]
                    np.testing.assert_array_equal(cell, block.cell[ends[at] : ends[at + 3]])
                    channel = np.repeat(np.arange(3), block.count[y, x])
                    weight = block.rho[y, x, channel] * block.weight[ends[at] : ends[at + 3]]
                    largest = np.array([weight[channel == c].max(initial=0) for c in range(3)])
                    off = code * strip.rho[y, x + left, channel] - weight
                    assert (np.abs(off) <= 1e-5 * largest[channel]).all()


def test_cells_far_apart_have_entries_of_no_weight_between_them(tmp_path: Path) -> None:
    cells = [3, 4, 4 + MOST, 5 + 2 * MOST, 6 + 5 * MOST]
    objects = Objects((tmp_path / "store").as_uri())
    matte = mattes.create(
        objects, "m", height=1, width=2, columns=7 * MOST, rows=1, crosstalk=np.eye(3).tolist()
    )
    yes = np.ones((1, 2), bool)
    ones = np.ones((1, 2, 3), np.float32)
    count = np.array([[[len(cells), 0, 0], [1, 0, 0]]], np.uint32)
    weight = np.ones(len(cells) + 1, np.float32)
    block = Block(ones, ones, ones[..., 0], yes, yes, count, np.array([*cells, 2], np.uint32), weight)
    matte.write(0, 0, block)
    strip = read_strip(matte, 0, 0)
    assert strip.count.tolist() == [[[9, 0, 0], [1, 0, 0]]]
    assert strip.first.tolist() == [3, 2]
    assert strip.step.tolist() == [0, 1, MOST, MOST, 1, MOST, MOST, MOST, 1, 0]
    assert (strip.code > 0).tolist() == [True, True, True, False, True, False, False, False, True, True]
    (row, _) = rows_of(strip)
    assert row[0][row[1] > 0].tolist() == cells


def test_a_window_over_two_strips_is_a_piece_of_the_whole(wide: Matte) -> None:
    backdrop = np.random.default_rng(1).random((30, 40, 3), np.float32)
    whole = composite(wide, backdrop, threads=1)
    assert whole[..., :3].std() > 0.1
    for x, width in ((0, WIDTH), (LENGTH - 3, 8), (LENGTH, 5), (5, LENGTH)):
        seen = composite(wide, backdrop, window=Window.of(wide, x, 9, width, 10), threads=2)
        np.testing.assert_array_equal(seen, whole[9:19, x : x + width])
