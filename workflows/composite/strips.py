"""A matte as it is composited: blocks side by side in one piece, as each call of a kernel costs some microseconds."""

from collections.abc import Set
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Block, Matte

LENGTH = 256
"""Pixels of a strip from left to right; the last one of a row may have fewer."""
Blocks = Set[tuple[int, int]]
"""Block rows and block columns."""


@dataclass(frozen=True)
class Strip:
    """Blocks of a block row, up to `LENGTH` pixels of it; h x w pixels.

    Attributes
    ----------
    S, rho : (h, w, 3) float32
    recovered, shared : (h, w) bool
    count : (h, w, 3) uint32
    cell : (count.sum(),) uint32
        In the order (y, x, channel).
    weight : (count.sum(),) float32
        In the same order.
    """

    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    recovered: NDArray[np.bool_]
    shared: NDArray[np.bool_]
    count: NDArray[np.uint32]
    cell: NDArray[np.uint32]
    weight: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))


def columns_of(matte: Matte, number: int) -> range:
    """The block columns of a strip."""
    blocks = LENGTH // matte.block
    return range(number * blocks, min((number + 1) * blocks, matte.block_columns))


def read_strip(matte: Matte, row: int, number: int, there: Blocks | None = None) -> Strip:
    """Read a strip.

    Parameters
    ----------
    matte : Matte
    row, number : int
        Its block row, and which one it is in it.
    there : set of (int, int), optional
        The blocks that a matte in the making has; what is not among them counts as not recovered.

    Raises
    ------
    Corrupt
        If a block is missing.
    """
    blocks = [
        matte.read(row, column) if there is None or (row, column) in there else _nothing(matte, row, column)
        for column in columns_of(matte, number)
    ]

    def side_by_side(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(block, name) for block in blocks], axis=1)

    # A block's entries come row of pixels by row of pixels, and so do the strip's.
    ends = [block.count.sum(axis=(1, 2)).cumsum()[:-1] for block in blocks]

    def in_rows(name: str) -> NDArray[Any]:
        parts = [np.split(getattr(block, name), end) for block, end in zip(blocks, ends, strict=True)]
        return np.concatenate([part for row in zip(*parts, strict=True) for part in row])

    return Strip(
        side_by_side("S"),
        side_by_side("rho"),
        side_by_side("recovered"),
        side_by_side("shared"),
        side_by_side("count"),
        in_rows("cell"),
        in_rows("weight"),
    )


def _nothing(matte: Matte, row: int, column: int) -> Block:
    height, width = (span.stop - span.start for span in matte.span(row, column))
    zero, no = np.zeros((height, width, 3), np.float32), np.zeros((height, width), bool)
    count = np.zeros((height, width, 3), np.uint32)
    return Block(zero, zero, zero[..., 0], no, no, count, np.zeros(0, np.uint32), np.zeros(0, np.float32))
