"""One pixel of a matte: the cells of the monitor that its light comes from, and its lobes."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, vstack

from storage.errors import InvalidInput
from storage.layout.mattes import Matte
from workflows.recovery.clusters.lobe_table import ranked_lobes
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.transport import Transport

SLAB = 1 << 16
"""Cells whose bumps are in memory at once."""
BLOCK_BYTES, PIXEL_BYTES = 24, 96
"""What a cell of a block takes while the block is read, and one of a pixel while it is looked into."""


@dataclass(frozen=True)
class Pixel:
    """A pixel, its n cells and its k lobes.

    Attributes
    ----------
    x, y : int
        Its place in the frame, from the top left.
    monitor : (int, int)
        Width and height of the monitor, in pixels.
    columns, rows : int
        The first grid of the cells.
    recovered : bool
        False where the mask excluded it; the fields that follow are then zero or empty.
    S, rho : (3,) float32
    node : (n,) int64
        Nodes of :class:`~workflows.recovery.pyramid.Pyramid`, heaviest first.
    weight : (n, 3) float32
        Their shares of each channel's light.
    lobes : (k, 8) float32
        See :func:`~workflows.recovery.clusters.lobe_table.ranked_lobes`.
    """

    x: int
    y: int
    monitor: tuple[int, int]
    columns: int
    rows: int
    recovered: bool
    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    node: NDArray[np.int64]
    weight: NDArray[np.float32]
    lobes: NDArray[np.float32]

    @property
    def levels(self) -> NDArray[np.int64]:
        """(n,) the grid of the pyramid that each cell is on."""
        return _places(Pyramid.over(self.columns, self.rows), self.node)[0]

    @property
    def cells(self) -> NDArray[np.float64]:
        """(n, 4) u and v of each cell's centre, and the cell's width and height; 0 to 1 over the monitor, v up.

        A cell of the first grid is a rectangle; one of a further grid is the middle of a smooth bump that is three
        times as wide and as high, cut off at the edge of the monitor.
        """
        pyramid = Pyramid.over(self.columns, self.rows)
        _, row, column, scale = _places(pyramid, self.node)
        u, v = pyramid.axis_moments(0)[column, 0], pyramid.axis_moments(1)[row, 0]
        sides = scale / self.columns, scale / self.rows
        return np.stack([u / self.columns, 1 - v / self.rows, *sides], axis=1)


def bytes_of_pixel(matte: Matte, x: int, y: int) -> int:
    """The memory that `look_into` takes, and drawing what it returns.

    Raises
    ------
    InvalidInput
        If there is no such pixel.
    Corrupt
        If its block is missing.
    """
    at, place = _find(matte, x, y)
    counts = matte.counts(*at)
    return BLOCK_BYTES * int(counts.sum(dtype=np.int64)) + PIXEL_BYTES * int(
        counts[place].sum(dtype=np.int64)
    )


def look_into(matte: Matte, x: int, y: int, lobes: int) -> Pixel:
    """Read a pixel of a matte. One block is read.

    Raises
    ------
    InvalidInput
        If there is no such pixel.
    Corrupt
        If its block is missing.
    """
    at, (i, j) = _find(matte, x, y)
    block = matte.read(*at)
    number = i * block.recovered.shape[1] + j
    counts = block.count.reshape(-1, 3).astype(np.int64)
    begin, size = int(counts[:number].sum()), counts[number]
    entries = slice(begin, begin + int(size.sum()))
    node, place = np.unique(block.cell[entries].astype(np.int64), return_inverse=True)
    weight = np.zeros((len(node), 3), np.float32)
    if block.shared[i, j]:
        weight[:] = block.weight[entries, np.newaxis]
    else:
        weight[place, np.repeat(np.arange(3), size)] = block.weight[entries]
    order = np.argsort(-weight.sum(axis=1), kind="stable")
    width, height = matte.attributes["monitor"]
    rows = Transport(
        matte.columns,
        matte.rows,
        block.count[i, j, np.newaxis],
        block.cell[entries],
        block.weight[entries],
        block.shared[i, j, np.newaxis],
    )
    ranked = ranked_lobes(rows, lobes, height / width)[0]
    return Pixel(
        x,
        y,
        (width, height),
        matte.columns,
        matte.rows,
        bool(block.recovered[i, j]),
        block.S[i, j],
        block.rho[i, j],
        node[order],
        weight[order],
        ranked[ranked[:, 2:5].any(axis=1)],
    )


def _find(matte: Matte, x: int, y: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The block of a pixel, and the pixel's row and column in it."""
    for name, value, size in (("x", x, matte.width), ("y", y, matte.height)):
        if not 0 <= value < size:
            raise InvalidInput(
                f"{name} is {value}: the pixels of this matte have {name} from 0 to {size - 1}, counted from the "
                f"{'left' if name == 'x' else 'top'}",
                field=name,
                limit=size - 1,
            )
    return (y // matte.block, x // matte.block), (y % matte.block, x % matte.block)


def contribution(
    pixel: Pixel, window: tuple[float, float, float, float], width: int, height: int
) -> NDArray[np.float64]:
    """How much light of each channel comes from each place of a part of the monitor.

    Parameters
    ----------
    pixel : Pixel
    window : (left, top, right, bottom)
        0 to 1 over the monitor, from its top left.
    width, height : int
        Places that the part is cut into.

    Returns
    -------
    (height, width, 3) float64
        Shares; over the whole monitor they sum to 1 in each channel.
    """
    pyramid = Pyramid.over(pixel.columns, pixel.rows)
    _, row, column, _ = _places(pyramid, pixel.node)
    across = _profiles(pyramid, 0, window[0], window[2], width)
    down = _profiles(pyramid, 1, window[1], window[3], height)
    shares = np.zeros((height, width, 3))
    for first in range(0, len(row), SLAB):
        slab = slice(first, first + SLAB)
        u, v = across[column[slab]], down[row[slab]].T
        for c in range(3):
            shares[..., c] += (v @ diags_array(pixel.weight[slab, c]) @ u).toarray()
    return shares


def _places(
    pyramid: Pyramid, node: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Of nodes: level, row and column, these counted through the grids, and spacing in cells of the first."""
    level = (np.searchsorted(pyramid.starts, node, "right") - 1).astype(np.int64)
    columns, rows = np.array(pyramid.grids).T
    row, column = np.divmod(node - pyramid.starts[level], columns[level])
    first_column, first_row = (np.concatenate([[0], np.cumsum(sizes)]) for sizes in (columns, rows))
    return level, row + first_row[level], column + first_column[level], np.ldexp(1.0, level)


def _profiles(pyramid: Pyramid, axis: int, start: float, stop: float, bins: int) -> csr_array:
    """(columns or rows of all grids, bins) the bumps along an axis, each of sum 1, in the bins of a part of it."""
    sizes = [grid[axis] for grid in pyramid.grids]
    # A cell of the first grid is even, so edges of cells and of bins cut the part into pieces of one cell and one bin.
    edges = np.linspace(start, stop, bins + 1) * sizes[0]
    cuts = np.union1d(edges, np.arange(np.ceil(edges[0]), np.floor(edges[-1]) + 1))
    middles = (cuts[1:] + cuts[:-1]) / 2
    cell = np.clip(middles.astype(np.int64), 0, sizes[0] - 1)
    bin = np.clip(np.searchsorted(edges, middles, "right") - 1, 0, bins - 1)
    profiles = [csr_array((np.diff(cuts), (cell, bin)), shape=(sizes[0], bins))]
    for finer, size in pairwise(sizes):
        node, offset = np.divmod(np.arange(4 * size), 4)
        taps = np.clip(2 * node - 1 + offset, 0, finer - 1)
        halved = csr_array((np.array([1, 3, 3, 1])[offset] / 8, (node, taps)), shape=(size, finer))
        profiles.append(halved @ profiles[-1])
    return csr_array(vstack(profiles))
