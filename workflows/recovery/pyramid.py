"""A pyramid of grids over the monitor, whose nodes are smooth bumps: the basis functions of T."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

Real = TypeVar("Real", np.float32, np.float64)
_COARSEST = 32
"""Most nodes along the longer side of the coarsest grid."""


class Grids(NamedTuple):
    """The grids of a pyramid as arrays, for kernels.

    Attributes
    ----------
    columns, rows : (levels,) int64
    starts : (levels + 1,) int64
        The first node of each grid, and the number of nodes.
    """

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    starts: NDArray[np.int64]


@dataclass(frozen=True)
class Pyramid:
    """Grids over the monitor, each with half as many columns and rows as the one before.

    A node of the first grid is a cell, and its light is the mean over the cell. The light of a node of any other grid
    is a weighted mean over nodes of the grid before, with the weights [1, 3, 3, 1] / 8 along each axis. The result is
    a smooth bump, close to a quadratic B-spline as wide as three of its cells, so sums of bumps show no grid.

    Attributes
    ----------
    grids : tuple of (int, int)
        Columns and rows of each grid, from fine to coarse. Nodes are numbered grid by grid, row by row.

    Notes
    -----
    Burt and Adelson, "The Laplacian pyramid as a compact image code", IEEE Trans. Communications, 1983.

    Examples
    --------
    >>> pyramid = Pyramid.over(64, 48)
    >>> pyramid.grids, pyramid.nodes
    (((64, 48), (32, 24)), 3840)
    """

    grids: tuple[tuple[int, int], ...]

    @classmethod
    def over(cls, columns: int, rows: int) -> Self:
        """The pyramid whose first grid has the given columns and rows."""
        grids = [(columns, rows)]
        while max(grids[-1]) > _COARSEST:
            grids.append((-(-grids[-1][0] // 2), -(-grids[-1][1] // 2)))
        return cls(tuple(grids))

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(len(grids) + 1,) int64: the first node of each grid, and the number of nodes."""
        return np.cumsum([0, *(columns * rows for columns, rows in self.grids)])

    @property
    def arrays(self) -> Grids:
        """`grids` and `starts`."""
        columns, rows = np.array(self.grids).T.copy()
        return Grids(columns, rows, self.starts)

    @property
    def nodes(self) -> int:
        """The number of nodes."""
        return int(self.starts[-1])

    def light(self, finest: NDArray[np.float32]) -> NDArray[np.float32]:
        """The light of every node.

        Parameters
        ----------
        finest : (rows, columns, channels) float32
            Mean light over the cells of the first grid.

        Returns
        -------
        (nodes, channels) float32

        Raises
        ------
        ValueError
            If `finest` does not have the size of the first grid.
        """
        if finest.shape[1::-1] != self.grids[0]:
            raise ValueError(f"the light must be on {self.grids[0]} cells, not {finest.shape[1::-1]}")
        parts = [finest]
        for _ in self.grids[1:]:
            parts.append(_halve(_halve(parts[-1], 0), 1))
        return np.concatenate([part.reshape(-1, finest.shape[2]) for part in parts])

    def axis_moments(self, axis: int) -> NDArray[np.float64]:
        """Means of x and of x squared over the bumps along an axis, in cells of the first grid from its edge.

        Parameters
        ----------
        axis : int
            0 for x, by columns; 1 for y, by rows.

        Returns
        -------
        (columns or rows of all grids, 2) float64
            Grid by grid. A node's bump is the product of its column's and its row's bump.

        Notes
        -----
        Computed as the light of nodes on a monitor with the light x or x squared, so exact at the edges too, where
        bumps are asymmetric.
        """
        centre = np.arange(self.grids[0][axis]) + 0.5
        parts = [np.stack([centre, centre**2 + 1 / 12], axis=1)]
        for _ in self.grids[1:]:
            parts.append(_halve(parts[-1], 0))
        return np.concatenate(parts)


def _halve(image: NDArray[Real], axis: int) -> NDArray[Real]:
    """Filter by [1, 3, 3, 1] / 8 along an axis and take every second value; the edge is repeated."""
    n = image.shape[axis]
    at = 2 * np.arange(-(-n // 2))
    outer = image.take(np.maximum(at - 1, 0), axis) + image.take(np.minimum(at + 2, n - 1), axis)
    inner = image.take(at, axis) + image.take(np.minimum(at + 1, n - 1), axis)
    halved: NDArray[Real] = (outer + 3 * inner) / np.float32(8)
    return halved


@njit("float64(int64)", nogil=True, cache=True)
def bump_variance(level: int) -> float:
    """Variance of the bumps of a level along an axis, in squared cells of the first grid.

    Notes
    -----
    A cell is a box, of variance 1/12. The weights [1, 3, 3, 1] / 8 have the variance 3/4, in squared spacings of the
    grid that they are applied to.
    """
    return 1 / 12 + (4.0**level - 1) / 4


@njit(nogil=True, cache=True)
def halve_codes(
    fine: NDArray[np.uint8], columns: int, rows: int, coarse: NDArray[np.uint8], sums: NDArray[np.uint16]
) -> None:
    """Compute the light of the next grid's nodes, in integers, for m images at once.

    Parameters
    ----------
    fine : (rows * columns, m) uint8
        Light of the nodes of a grid.
    columns, rows : int
        Size of that grid.
    coarse : (nodes of the next grid, m) uint8
        Written, rounded to nearest.
    sums : (m,) uint16
        Working space.
    """
    half = (columns + 1) // 2
    m = fine.shape[1]
    for y in range((rows + 1) // 2):
        for x in range(half):
            sums[:] = 32
            for i in range(4):
                row = min(max(2 * y - 1 + i, 0), rows - 1) * columns
                for j in range(4):
                    weight = np.uint16((3 if 0 < i < 3 else 1) * (3 if 0 < j < 3 else 1))
                    seen = fine[row + min(max(2 * x - 1 + j, 0), columns - 1)]
                    for k in range(m):
                        sums[k] += weight * seen[k]
            written = coarse[y * half + x]
            for k in range(m):
                written[k] = sums[k] >> 6
