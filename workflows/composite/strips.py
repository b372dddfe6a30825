"""Strips of a matte: blocks side by side in one piece, because each call of a kernel costs some microseconds."""

from collections.abc import Set
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte, empty_block

LENGTH = 256
"""Width of a strip in pixels; the last one of a row may have fewer."""
Blocks = Set[tuple[int, int]]
"""Pairs of block row and block column."""


@dataclass(frozen=True)
class Strip:
    """Blocks of a block row, h x w pixels, up to `LENGTH` wide.

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
        """Size of its arrays; 0 if nothing is recovered, for all such strips share theirs."""
        return sum(getattr(self, field.name).nbytes for field in fields(self)) if self.recovered.any() else 0


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
        Its block row, and its number in that row.
    there : set of (int, int), optional
        The blocks that exist of an unfinished matte; all others count as not recovered.

    Raises
    ------
    Corrupt
        If a block is missing.
    """
    blocks = [
        matte.read(row, column)
        if there is None or (row, column) in there
        else empty_block(*(span.stop - span.start for span in matte.span(row, column)))
        for column in columns_of(matte, number)
    ]

    if not any(block.recovered.any() for block in blocks):
        return _empty_strip(len(blocks[0].recovered), sum(block.recovered.shape[1] for block in blocks))

    def side_by_side(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(block, name) for block in blocks], axis=1)

    # Entries of blocks, and of the strip, are in the order of the rows of pixels.
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


@lru_cache(maxsize=8)
def _empty_strip(height: int, width: int) -> Strip:
    """A strip in which nothing is recovered. Those of a frame have few sizes."""
    block = empty_block(height, width)
    return Strip(**{field.name: getattr(block, field.name) for field in fields(Strip)})
