"""Blocks of random values for the tests of mattes."""

import numpy as np

from storage.layout.mattes import Block, Matte

CELLS = 12
"""Cells of a monitor of 4 x 3."""


def block(height: int, width: int, seed: int) -> Block:
    """A block of random values."""
    rng = np.random.default_rng(seed)
    recovered = rng.random((height, width)) < 0.8
    count = rng.integers(0, 4, (height, width, 3), np.uint32) * recovered[..., None]
    entries = int(count.sum())
    return Block(
        rng.random((height, width, 3), np.float32),
        rng.random((height, width, 3), np.float32),
        rng.random((height, width), np.float32),
        recovered,
        rng.random((height, width)) < 0.5,
        count.astype(np.uint32),
        rng.integers(0, CELLS, entries, np.uint32),
        rng.random(entries, np.float32),
    )


def zeros(height: int, width: int, entries: int) -> Block:
    """A block of zeros, with `entries` entries in its first row T."""
    light = np.zeros((height, width, 3), np.float32)
    count = np.zeros((height, width, 3), np.uint32)
    count[0, 0, 0] = entries
    cell, weight = np.zeros(entries, np.uint32), np.zeros(entries, np.float32)
    nowhere = np.zeros((height, width), bool)
    return Block(light, light, light[..., 0], nowhere, nowhere, count, cell, weight)


def places(matte: Matte) -> list[tuple[int, int]]:
    """Row and column of every block."""
    return [(row, column) for row in range(matte.block_rows) for column in range(matte.block_columns)]


def extent(matte: Matte, row: int, column: int) -> tuple[int, int]:
    """Height and width of a block in pixels."""
    y, x = matte.span(row, column)
    return y.stop - y.start, x.stop - x.start
