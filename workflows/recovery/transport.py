"""T as a sparse matrix: for each pixel and channel, the monitor's cells that its light comes from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

LEAST_WEIGHT = 1e-4
"""Entries below this share of their row's sum are dropped."""


@dataclass(frozen=True)
class Transport:
    """Sparse non-negative rows T of eq. 5, for n pixels with three channels.

    Attributes
    ----------
    columns, rows : int
        The first grid of the pyramid whose nodes the cells are. Methods without a pyramid use this grid only.
    count : (n, 3) uint32
        Number of cells of each row; 0 where nothing could be recovered.
    cell : (count.sum(),) uint32
        Nodes of :class:`~workflows.recovery.pyramid.Pyramid` over the grid, ``row * columns + column`` on the grid
        itself. Cells ascend within a row; rows are in the order (pixel, channel).
    weight : (count.sum(),) float32
        Share of the light, positive; each row sums to 1.
    shared : (n,) bool
        Whether a pixel's first row serves all channels and its other rows are empty.
    """

    columns: int
    rows: int
    count: NDArray[np.uint32]
    cell: NDArray[np.uint32]
    weight: NDArray[np.float32]
    shared: NDArray[np.bool_]

    @classmethod
    def from_rows(
        cls,
        columns: int,
        rows: int,
        count: NDArray[np.integer],
        cell: NDArray[np.integer],
        weight: NDArray[np.floating],
        shared: NDArray[np.bool_] | None = None,
        least_weight: float = LEAST_WEIGHT,
    ) -> Self:
        """Make a transport from a solver's rows: drop small entries and normalise each row to a sum of 1.

        Parameters
        ----------
        columns, rows : int
            The grid of the cells.
        count : (n, 3) integer
            Number of entries of each row.
        cell : (count.sum(),) integer
            Cells, ascending within a row.
        weight : (count.sum(),) float
            Weights, zero or more. A row of sum 0 becomes empty.
        shared : (n,) bool, optional
            Default: False for all pixels.
        least_weight : float
            Entries below this share of their row's sum are dropped.

        Returns
        -------
        Transport

        Raises
        ------
        ValueError
            If the shapes do not match, a weight is negative or not finite, or cells do not ascend within a row.
        """
        sizes = count.ravel().astype(np.int64)
        if count.ndim != 2 or count.shape[1] != 3 or not cell.shape == weight.shape == (int(sizes.sum()),):
            raise ValueError("count must be (n, 3), cell and weight (count.sum(),)")
        if not (np.isfinite(weight).all() and (weight >= 0).all()):
            raise ValueError("weights must be finite and not negative")
        row = np.repeat(np.arange(sizes.size), sizes)
        ascending = np.diff(cell.astype(np.int64)) > 0
        if not (ascending | (np.diff(row) > 0)).all():
            raise ValueError("cells must ascend within a row")
        exact = weight.astype(np.float64)
        total = np.bincount(row, exact, sizes.size)
        keep = (exact >= least_weight * total[row]) & (exact > 0)
        row, exact = row[keep], exact[keep]
        exact /= np.bincount(row, exact, sizes.size)[row]
        kept = np.bincount(row, minlength=sizes.size).reshape(count.shape)
        return cls(
            columns,
            rows,
            kept.astype(np.uint32),
            cell[keep].astype(np.uint32),
            exact.astype(np.float32),
            np.zeros(len(count), bool) if shared is None else shared,
        )

    @classmethod
    def from_entries(
        cls,
        columns: int,
        rows: int,
        count: NDArray[np.integer],
        cell: NDArray[np.integer],
        weight: NDArray[np.floating],
        shared: NDArray[np.bool_],
        least_weight: float,
    ) -> Self:
        """As `from_rows`, of entries whose cells need not ascend within a row and may repeat: weights are added."""
        row = np.repeat(np.arange(count.size), count.ravel())
        order = np.lexsort((cell, row))
        row, cell, weight = row[order], cell[order], weight[order]
        new = np.append(True, (np.diff(row) > 0) | (np.diff(cell) > 0))[: row.size]
        begin = np.flatnonzero(new)
        merged = np.add.reduceat(weight, begin) if begin.size else weight
        count = np.bincount(row[begin], minlength=count.size).reshape(count.shape)
        return cls.from_rows(columns, rows, count, cell[begin], merged, shared, least_weight)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Concatenate the pixels of several transports on the same grid.

        Raises
        ------
        ValueError
            If there are no parts, or their grids differ.
        """
        if len({(part.columns, part.rows) for part in parts}) != 1:
            raise ValueError("concatenate needs at least one transport, and all must be on the same grid")
        return cls(
            parts[0].columns,
            parts[0].rows,
            np.concatenate([part.count for part in parts]),
            np.concatenate([part.cell for part in parts]),
            np.concatenate([part.weight for part in parts]),
            np.concatenate([part.shared for part in parts]),
        )

    def apply(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Apply T to the monitor's light: T L of eq. 5.

        Parameters
        ----------
        light : (nodes, 3) float32
            L, the light of each node of the pyramid and channel. Nodes after the last cell can be left out.

        Returns
        -------
        (n, 3) float32
            0 where a row is empty.

        Raises
        ------
        ValueError
            If the shape is wrong or `light` has no row for some cell.
        """
        sizes = self.count.ravel().astype(np.int64)
        if light.ndim != 2 or light.shape[1] != 3 or len(light) <= int(self.cell.max(initial=0)):
            raise ValueError(f"light must be (nodes, 3) with a row for every cell, not {light.shape}")
        row = np.repeat(np.arange(sizes.size), sizes)
        exact = self.weight.astype(np.float64)
        arrived = np.stack(
            [np.bincount(row, exact * light[self.cell, c], sizes.size) for c in range(3)], axis=1
        )
        arrived = arrived.reshape(-1, 3, 3)
        own = arrived[:, [0, 1, 2], [0, 1, 2]]
        return np.where(self.shared[:, np.newaxis], arrived[:, 0], own).astype(np.float32)


def ragged_entries(begin: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Concatenate ranges of indices.

    Parameters
    ----------
    begin, sizes : (k,) int64
        First index and length of each range.

    Returns
    -------
    (sizes.sum(),) int64

    Examples
    --------
    >>> import numpy as np
    >>> ragged_entries(np.array([4, 0]), np.array([3, 2]))
    array([4, 5, 6, 0, 1])
    """
    shift = begin - (np.cumsum(sizes) - sizes)
    entries: NDArray[np.int64] = np.arange(sizes.sum()) + np.repeat(shift, sizes)
    return entries
