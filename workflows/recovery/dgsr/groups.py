"""Sparse rows of T on a grid, sums over groups of neighbouring cells, and refinement to the next grid."""

from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.sensing import Level
from workflows.recovery.transport import Transport, ragged_entries

NEIGHBOUR_SHARE = 0.5
"""Weight of each of the eight neighbours in a cell's group, where the cell itself has weight 1."""


class Rows(NamedTuple):
    """Sparse rows of T that are being solved for, one per problem.

    Attributes
    ----------
    begin : (n + 1,) int64
        Row p has the entries ``begin[p]`` to ``begin[p + 1] - 1``.
    cell : (begin[n],) int32
        Cells ``row * columns + column``, ascending within a row.
    weight : (begin[n],) float32
        Weights, zero or more; solvers overwrite them.
    """

    begin: NDArray[np.int64]
    cell: NDArray[np.int32]
    weight: NDArray[np.float32]

    @classmethod
    def whole(cls, n: int, level: Level) -> Self:
        """n rows with every cell of a level, all of weight 0."""
        cells = level.columns * level.rows
        return cls(
            np.arange(n + 1) * cells,
            np.tile(np.arange(cells, dtype=np.int32), n),
            np.zeros(n * cells, np.float32),
        )

    def take(self, index: NDArray[np.integer]) -> Self:
        """Copies of the given rows, in the given order."""
        sizes = np.diff(self.begin)[index]
        entries = ragged_entries(self.begin[:-1][index], sizes)
        return type(self)(
            np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)]),
            self.cell[entries],
            self.weight[entries],
        )

    def split(self, parent: Level, child: Level, least_group: float, reach: int) -> "Rows":
        """Prune cells, add neighbours of those kept, and split every cell into its children.

        Parameters
        ----------
        parent, child : Level
            The level of these rows, and the next finer one.
        least_group : float
            A cell is kept if its weight plus half the sum of its eight neighbours' weights is above this.
        reach : int
            Cells within this many rows and columns of a kept one are added, with their own weights.

        Returns
        -------
        Rows
            Rows on the finer grid. The children of a cell have equal shares of its weight.
        """
        across, down = child.columns // parent.columns, child.rows // parent.rows
        split: Rows = split_cells(self, parent.columns, parent.rows, across, down, least_group, reach)
        return split

    def transport(self, level: Level, index: NDArray[np.integer]) -> Transport:
        """Transport of n pixels from ``index (n, 3)``, the row of each channel; -1 gives an empty one."""
        flat = index.ravel()
        taken = self.take(flat[flat >= 0])
        count = np.zeros(flat.size, np.int64)
        count[flat >= 0] = np.diff(taken.begin)
        return Transport.from_rows(
            level.columns, level.rows, count.reshape(index.shape), taken.cell, taken.weight
        )


@njit(nogil=True, cache=True)
def group_sums(
    cell: NDArray[np.int32],
    value: NDArray[np.float32],
    columns: int,
    field: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write each cell's value plus half the sum of its eight neighbours' values.

    Parameters
    ----------
    cell : (s,) int32
        Cells ``row * columns + column``.
    value : (s,) float32
        Their values; other cells have the value 0.
    columns : int
        Columns of the grid.
    field : (rows + 2, columns + 2) float32
        Working space, all zero before and after.
    out : (s,) float32
        Written.
    """
    share = np.float32(NEIGHBOUR_SHARE)
    for e in range(cell.size):
        r, c = divmod(cell[e], columns)
        field[r + 1, c + 1] = value[e]
    for e in range(cell.size):
        r, c = divmod(cell[e], columns)
        around = np.float32(0)
        for v in range(r, r + 3):
            around += field[v, c] + field[v, c + 1] + field[v, c + 2]
        out[e] = value[e] + share * (around - value[e])
    for e in range(cell.size):
        r, c = divmod(cell[e], columns)
        field[r + 1, c + 1] = 0


@njit(nogil=True, cache=True)
def split_cells(
    coarse: Rows, columns: int, rows: int, across: int, down: int, least_group: float, reach: int
) -> Rows:
    """Kernel of :meth:`Rows.split`; a cell of the ``columns`` by ``rows`` grid has ``across * down`` children."""
    begin, cell, weight = coarse
    n = begin.size - 1
    field = np.zeros((rows + 2, columns + 2), np.float32)
    kept = np.zeros((rows, columns), np.bool_)
    children = across * down
    new_begin = np.zeros(n + 1, np.int64)
    new_cell = np.empty(1024, np.int32)
    new_weight = np.empty(1024, np.float32)
    end = 0
    for p in range(n):
        cells, weights = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        group = np.empty(cells.size, np.float32)
        group_sums(cells, weights, columns, field, group)
        marked, top, bottom, left, right = _mark_kept(cells, group, least_group, reach, kept)
        for e in range(cells.size):
            r, c = divmod(cells[e], columns)
            field[r + 1, c + 1] = weights[e]
        while end + marked * children > new_cell.size:
            new_cell = np.concatenate((new_cell, np.empty_like(new_cell)))
            new_weight = np.concatenate((new_weight, np.empty_like(new_weight)))
        for v in range(top * down, (bottom + 1) * down):
            for u in range(left, right + 1):
                if kept[v // down, u]:
                    for i in range(across):
                        new_cell[end] = (v * columns + u) * across + i
                        new_weight[end] = field[v // down + 1, u + 1] / np.float32(children)
                        end += 1
        for v in range(top, bottom + 1):
            kept[v, left : right + 1] = False
        for e in range(cells.size):
            r, c = divmod(cells[e], columns)
            field[r + 1, c + 1] = 0
        new_begin[p + 1] = end
    return Rows(new_begin, new_cell[:end].copy(), new_weight[:end].copy())


@njit(nogil=True, cache=True)
def _mark_kept(
    cell: NDArray[np.int32],
    group: NDArray[np.float32],
    least_group: float,
    reach: int,
    kept: NDArray[np.bool_],
) -> tuple[int, int, int, int, int]:
    """Mark the cells within reach of those whose group sum is above `least_group`.

    `kept`, (rows, columns), is all false before.

    Returns
    -------
    marked : int
        Number of cells marked.
    top, bottom, left, right : int
        The first and last row and column with a marked cell; the last is below the first if there is none.
    """
    rows, columns = kept.shape
    top, bottom, left, right = rows, -1, columns, -1
    marked = 0
    for e in range(cell.size):
        if group[e] > least_group:
            r, c = divmod(cell[e], columns)
            r0, r1 = max(r - reach, 0), min(r + reach, rows - 1)
            c0, c1 = max(c - reach, 0), min(c + reach, columns - 1)
            top, bottom, left, right = min(top, r0), max(bottom, r1), min(left, c0), max(right, c1)
            for v in range(r0, r1 + 1):
                for u in range(c0, c1 + 1):
                    marked += not kept[v, u]
                    kept[v, u] = True
    return marked, top, bottom, left, right
