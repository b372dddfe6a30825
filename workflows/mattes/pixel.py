"""One pixel of a matte: the cells of the monitor that its light comes from, and its lobes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.errors import InvalidInput
from storage.layout.mattes import Matte
from workflows.mattes.lobes import block_lobes
from workflows.recovery.pyramid import Pyramid


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
        See :func:`~workflows.recovery.lobe_table.ranked_lobes`.
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


def look_into(matte: Matte, x: int, y: int, lobes: int) -> Pixel:
    """Read a pixel of a matte. One block is read.

    Raises
    ------
    InvalidInput
        If there is no such pixel.
    Corrupt
        If its block is missing.
    """
    for name, value, size in (("x", x, matte.width), ("y", y, matte.height)):
        if not 0 <= value < size:
            raise InvalidInput(
                f"{name} is {value}: the pixels of this matte have {name} from 0 to {size - 1}, counted from the "
                f"{'left' if name == 'x' else 'top'}",
                field=name,
                limit=size - 1,
            )
    at = y // matte.block, x // matte.block
    block = matte.read(*at)
    i, j = y % matte.block, x % matte.block
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
    ranked = block_lobes(matte, block, lobes)[i, j]
    width, height = matte.attributes["monitor"]
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
    level, row, column, _ = _places(pyramid, pixel.node)
    columns, rows = (np.cumsum([0, *sizes]) for sizes in zip(*pyramid.grids, strict=True))
    across = _profiles(pyramid, 0, level, column - columns[level], window[0], window[2], width)
    down = _profiles(pyramid, 1, level, row - rows[level], window[1], window[3], height)
    return np.stack([(down * pixel.weight[:, c, np.newaxis]).T @ across for c in range(3)], axis=-1)


def _places(
    pyramid: Pyramid, node: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Of nodes: level, row and column, these counted through the grids, and spacing in cells of the first."""
    level = (np.searchsorted(pyramid.starts, node, "right") - 1).astype(np.int64)
    columns, rows = np.array(pyramid.grids).T
    row, column = np.divmod(node - pyramid.starts[level], columns[level])
    first_column, first_row = (np.concatenate([[0], np.cumsum(sizes)]) for sizes in (columns, rows))
    return level, row + first_row[level], column + first_column[level], np.ldexp(1.0, level)


def _profiles(
    pyramid: Pyramid,
    axis: int,
    level: NDArray[np.int64],
    place: NDArray[np.int64],
    start: float,
    stop: float,
    bins: int,
) -> NDArray[np.float64]:
    """(n, bins) the bumps of nodes along an axis, each of sum 1, in the bins of a part of it."""
    sizes = [grid[axis] for grid in pyramid.grids]
    bumps = np.zeros((len(level), sizes[-1]))
    for at in reversed(range(len(sizes))):
        here = np.flatnonzero(level == at)
        bumps[here, place[here]] = 1
        if at == 0:
            break
        finer = np.zeros((sizes[at - 1], len(level)))
        for offset, share in zip((-1, 0, 1, 2), (1, 3, 3, 1), strict=True):
            taps = np.clip(2 * np.arange(sizes[at]) + offset, 0, sizes[at - 1] - 1)
            np.add.at(finer, taps, bumps.T * share / 8)
        bumps = finer.T
    # What lies left of each edge of a bin, linear within a cell.
    edges = np.linspace(start, stop, bins + 1) * sizes[0]
    below = np.minimum(edges.astype(np.int64), sizes[0] - 1)
    sums = np.concatenate([np.zeros((len(level), 1)), np.cumsum(bumps, axis=1)], axis=1)
    return np.diff(sums[:, below] + (edges - below) * bumps[:, below], axis=1)
