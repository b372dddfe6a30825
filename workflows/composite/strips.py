"""Strips of a matte: blocks side by side in one piece, because each call of a kernel costs some microseconds.

Rows T take half of the memory that they do in the store, and half as much is read for each composite: a cell is stored
as its distance from the one before, and a weight as a multiple of a unit that each row has, 16 bits each. A weight is
off by 1e-5 of the row's largest at most.
"""

from collections.abc import Set
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.errors import Corrupt
from storage.layout.mattes import Block, Matte, empty_block

LENGTH = 256
"""Width of a strip in pixels; the last one of a row may have fewer."""
MOST = 65535
"""The largest distance of two cells, and the code of a row's largest weight."""
Blocks = Set[tuple[int, int]]
"""Pairs of block row and block column."""
Rows = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint16], NDArray[np.uint16]]
"""The rows T of a strip: its `count`, `first`, `step` and `code`."""


@dataclass(frozen=True)
class Strip:
    """Blocks of a block row, h x w pixels, up to `LENGTH` wide.

    Attributes
    ----------
    S : (h, w, 3) float32
    rho : (h, w, 3) float32
        Times the unit of the row T.
    recovered, shared : (h, w) bool
    count : (h, w, 3) uint32
        Entries of each row T. Cells that are farther apart than `MOST` have entries of no weight between them.
    first : (k,) uint32
        The first cell of each row T that has entries, in the order (y, x, channel).
    step : (count.sum(),) uint16
        The distance of each cell from the one before; 0 for the first.
    code : (count.sum(),) uint16
        Weights in units of the row.
    """

    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    recovered: NDArray[np.bool_]
    shared: NDArray[np.bool_]
    count: NDArray[np.uint32]
    first: NDArray[np.uint32]
    step: NDArray[np.uint16]
    code: NDArray[np.uint16]

    @property
    def rows(self) -> Rows:
        """The rows T, for kernels."""
        return self.count, self.first, self.step, self.code

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
        If a block is missing, or cells of a row T do not ascend.
    """
    blocks = [
        matte.read(row, column)
        if there is None or (row, column) in there
        else empty_block(*(span.stop - span.start for span in matte.span(row, column)))
        for column in columns_of(matte, number)
    ]

    if not any(block.recovered.any() for block in blocks):
        return _empty_strip(len(blocks[0].recovered), sum(block.recovered.shape[1] for block in blocks))

    parts = [_packed(block) for block in blocks]

    def side_by_side(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts], axis=1)

    def in_rows(name: str, counts: list[NDArray[np.uint32]]) -> NDArray[Any]:
        """What the parts have in the order of their rows of pixels, in that order for the strip."""
        ends = [count.sum(axis=(1, 2)).cumsum()[:-1] for count in counts]
        pieces = [np.split(getattr(part, name), end) for part, end in zip(parts, ends, strict=True)]
        return np.concatenate([piece for row in zip(*pieces, strict=True) for piece in row])

    counts = [part.count for part in parts]
    has_entries = [(count > 0).astype(np.uint32) for count in counts]
    return Strip(
        side_by_side("S"),
        side_by_side("rho"),
        side_by_side("recovered"),
        side_by_side("shared"),
        side_by_side("count"),
        in_rows("first", has_entries),
        in_rows("step", counts),
        in_rows("code", counts),
    )


def _packed(block: Block) -> Strip:
    """A block as a strip of its own."""
    count, unit = np.zeros(block.count.shape, np.uint32), np.ones(block.count.shape, np.float32)
    first = np.empty(np.count_nonzero(block.count), np.uint32)
    apart = np.maximum(np.diff(block.cell.astype(np.int64)), 0)
    step, code = np.zeros((2, block.cell.size + int((apart // MOST).sum())), np.uint16)
    total = _pack(block.count, block.cell, block.weight, count, first, step, code, unit)
    if total < 0:  # compiled code would read beyond the light
        raise Corrupt("the matte has a row of T whose cells do not ascend; recover the matte again")
    unit = np.where(block.shared[..., np.newaxis], unit[..., :1], unit)
    rho = block.rho * unit
    return Strip(block.S, rho, block.recovered, block.shared, count, first, step[:total], code[:total])


@njit(nogil=True, cache=True)
def _pack(
    entries: NDArray[np.uint32],
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    count: NDArray[np.uint32],
    first: NDArray[np.uint32],
    step: NDArray[np.uint16],
    code: NDArray[np.uint16],
    unit: NDArray[np.float32],
) -> int:
    """Write what a strip has of rows T; `step` and `code` begin as zeros.

    Returns how many entries that are, or -1 if the cells of a row do not ascend.
    """
    height, width, channels = entries.shape
    entry, row, to = 0, 0, 0
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                end = entry + int(entries[y, x, c])
                if end == entry:
                    continue
                largest = np.float32(0)
                for at in range(entry, end):
                    largest = max(largest, weight[at])
                if largest > 0:
                    unit[y, x, c] = largest / np.float32(MOST)
                first[row] = cell[entry]
                row += 1
                begin, before = to, int(cell[entry])
                for at in range(entry, end):
                    if cell[at] < before:
                        return -1
                    while cell[at] - before > MOST:
                        step[to] = MOST
                        before += MOST
                        to += 1
                    step[to] = cell[at] - before
                    code[to] = np.uint16(min(weight[at] / unit[y, x, c] + np.float32(0.5), MOST))
                    before = int(cell[at])
                    to += 1
                count[y, x, c] = to - begin
                entry = end
    return to


@lru_cache(maxsize=8)
def _empty_strip(height: int, width: int) -> Strip:
    """A strip in which nothing is recovered. Those of a frame have few sizes."""
    return _packed(empty_block(height, width))
