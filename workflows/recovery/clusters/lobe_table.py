"""The lobes of every pixel, heaviest first: rows of T as a few Gaussians that other tools can work with."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.clusters.gaussians import merge_clusters
from workflows.recovery.clusters.merging import (
    CLUSTER_VALUES,
    MOMENTS,
    central_moments,
    merge_near,
    merge_squares,
)
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.transport import Transport

FIELDS = ("u", "v", "weight.R", "weight.G", "weight.B", "sigma_u", "sigma_v", "theta")
"""The columns of a lobe table."""

_SPACING = 0.5
"""Least standard deviation of a cluster, in spacings of its grid: adjacent nodes merge, diagonal ones included."""
_MOST_CLUSTERS, _MOST_WIDENING = 32, 4.0**6
"""While a pixel has more clusters than this, those in each 2 x 2 square of a grid merge, and the least variance grows
four times, up to this factor."""
_MOST_WORK = 96
"""Most clusters of a pixel all the same, whatever the factor: the time of what follows grows with their cube."""
_MOST_READ = 1 << 14
"""Clusters of a pixel that are held while its entries are read; if there are more, squares merge already then."""
_CHUNK = 64
"""Pixels of one call of the kernel: some tenths of a second at worst."""


def ranked_lobes(
    transport: Transport, most: int, aspect: float, between: Callable[[], None] = lambda: None
) -> NDArray[np.float32]:
    """Find the lobes of each pixel.

    Parameters
    ----------
    transport : Transport
        T of n pixels.
    most : int
        Largest number of lobes of a pixel.
    aspect : float
        Height of the monitor divided by its width.
    between : callable, optional
        Is called again and again, at least every second or so; an exception ends the work.

    Returns
    -------
    (n, most, 8) float32
        Columns as in `FIELDS`. Heaviest lobe first, by the mean weight of the channels; the rest is 0.

        - ``u``, ``v``: the centre, 0 to 1 over the monitor, u to the right and v up, from its bottom left corner. The
          centre of the monitor's pixel (x, y), y down, is ((x + 0.5) / width, 1 - (y + 0.5) / height).
        - ``weight``: the lobe's share of a channel's light. The weights of a pixel sum to 1 in each channel.
        - ``sigma_u``, ``sigma_v``: standard deviations along the axes of the ellipse, both in units of the monitor's
          width, so that they and the angle are those seen on the monitor. They include the extent of the cells.
        - ``theta``: angle in radians, counter-clockwise, from the u axis to the axis of ``sigma_u``, -pi/4 to pi/4:
          ``sigma_u`` is along the axis of the ellipse that is closer to u.

    Raises
    ------
    ValueError
        If `most` or `aspect` is not positive.

    Notes
    -----
    Each node starts as a cluster with the mean and the variance of its bump, cut off at the edges of the monitor.
    Clusters merge by their moments, at least cost first (Ward, see :func:`.clusters.gaussians.merge_clusters`). The
    first merges are limited to clusters that overlap and whose grids are at most one level apart, so that a sharp lobe
    on a broad one stays separate. If more than `most` are left, any two may merge. The light of a pixel that comes from
    very many places is merged in squares before, so that no pixel takes more than some milliseconds.

    The three channels' rows of a pixel are clustered together, so a lobe has one centre and three weights. Channels
    with different centres get separate lobes, even where these overlap.

    In the monitor's plane, ``(u, v aspect)``, a lobe's covariance is ``R diag(sigma_u^2, sigma_v^2) R^T``, R the
    rotation by theta.

    Examples
    --------
    A pixel that sees one cell of a grid of 4 x 3 in all channels, the second from the left in the middle row:

    >>> count, cell = np.array([[1, 0, 0]], np.uint32), np.array([5], np.uint32)
    >>> transport = Transport(4, 3, count, cell, np.ones(1, np.float32), np.array([True]))
    >>> lobes = ranked_lobes(transport, most=2, aspect=0.75)
    >>> print(lobes.round(3))
    [[[0.375 0.5   1.    1.    1.    0.072 0.072 0.   ]
      [0.    0.    0.    0.    0.    0.    0.    0.   ]]]
    """
    if most < 1 or not aspect > 0:
        raise ValueError(f"most must be at least 1 and aspect positive, not {most} and {aspect}")
    pyramid = Pyramid.over(transport.columns, transport.rows)
    sizes = transport.count.astype(np.int64)
    begin = np.concatenate([[0], np.cumsum(sizes.sum(axis=1))])
    spacing = max(1 / transport.columns, aspect / transport.rows) * 2.0 ** np.arange(len(pyramid.grids))
    lobes = np.zeros((len(sizes), most, len(FIELDS)), np.float32)
    bumps, least_variance = _bumps_of(pyramid, aspect), (_SPACING * spacing) ** 2
    clusters = np.empty((min(int(np.diff(begin).max(initial=0)), _MOST_READ), CLUSTER_VALUES))
    for first in range(0, len(sizes), _CHUNK):
        between()
        chunk = slice(first, first + _CHUNK)
        _rank(
            sizes[chunk],
            begin[chunk],
            transport.cell,
            transport.weight,
            transport.shared[chunk],
            bumps,
            least_variance,
            clusters,
            lobes[chunk],
        )
    lobes[..., 1] /= np.float32(aspect)
    return lobes


class _Bumps(NamedTuple):
    """Moments of the bumps of a pyramid's nodes, in units of the monitor's width, v up.

    Attributes
    ----------
    starts : (levels + 1,) int64
        As in :class:`~workflows.recovery.pyramid.Grids`.
    columns : (levels,) int64
    first_column, first_row : (levels + 1,) int64
        Where each level begins in `across` and `up`.
    across, up : (columns or rows of all levels, 2) float64
        Means of u and u squared over each column's bump, and of v and v squared over each row's.
    """

    starts: NDArray[np.int64]
    columns: NDArray[np.int64]
    first_column: NDArray[np.int64]
    first_row: NDArray[np.int64]
    across: NDArray[np.float64]
    up: NDArray[np.float64]


def _bumps_of(pyramid: Pyramid, aspect: float) -> _Bumps:
    """Moments of all bumps on a monitor of the given aspect."""
    wide, high = pyramid.grids[0]
    columns, rows, starts = pyramid.arrays
    x, y = pyramid.axis_moments(0), pyramid.axis_moments(1)
    across = np.stack([x[:, 0] / wide, x[:, 1] / wide**2], axis=1)
    down = y / [high, high**2]
    up = np.stack([1 - down[:, 0], 1 - 2 * down[:, 0] + down[:, 1]], axis=1) * [aspect, aspect**2]
    first_column, first_row = (np.concatenate([[0], np.cumsum(sizes)]) for sizes in (columns, rows))
    return _Bumps(starts, columns, first_column, first_row, across, up)


@njit(nogil=True, cache=True)
def _rank(
    sizes: NDArray[np.int64],
    begin: NDArray[np.int64],
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    shared: NDArray[np.bool_],
    bumps: _Bumps,
    least_variance: NDArray[np.float64],
    clusters: NDArray[np.float64],
    lobes: NDArray[np.float32],
) -> None:
    """Write the lobes of one pixel after another, v in units of the monitor's width."""
    node, level = np.empty((len(clusters), 2), np.int64), np.empty(len(clusters), np.int64)
    for i in range(len(sizes)):
        n, halvings = _read_clusters(
            sizes[i], begin[i], cell, weight, shared[i], bumps, clusters, node, level
        )
        widening = 4.0**halvings
        while n > _MOST_CLUSTERS and (widening < _MOST_WIDENING or n > _MOST_WORK):
            n = merge_squares(clusters, node, level, n)
            widening *= 4
        n = merge_near(clusters, level, n, least_variance * widening, shared[i])
        n = merge_clusters(clusters, n, lobes.shape[1])
        for k in range(n):
            heaviest = k
            for other in range(k + 1, n):
                if clusters[other, 0] > clusters[heaviest, 0]:
                    heaviest = other
            _describe(clusters[heaviest], lobes[i, k])
            clusters[heaviest] = clusters[k]


@njit(nogil=True, cache=True)
def _read_clusters(
    sizes: NDArray[np.int64],
    entry: int,
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    shared: bool,
    bumps: _Bumps,
    clusters: NDArray[np.float64],
    node: NDArray[np.int64],
    level: NDArray[np.int64],
) -> tuple[int, int]:
    """Write a cluster for each entry of a pixel's rows, with its row, column and level.

    `sizes`, (3,), are the entries of each channel; the first is `entry`. Returns the number of clusters, and how often
    squares were merged to make room for all.
    """
    n, halvings = 0, 0
    for channel in range(3):
        for _ in range(sizes[channel]):
            if n == len(clusters):
                while n > len(clusters) // 2:
                    n = merge_squares(clusters, node, level, n)
                    halvings += 1
            number = np.int64(cell[entry])
            at = np.searchsorted(bumps.starts, number, "right") - 1
            row, column = divmod(number - bumps.starts[at], bumps.columns[at])
            x, y = bumps.across[bumps.first_column[at] + column], bumps.up[bumps.first_row[at] + row]
            node[n, 0], node[n, 1], level[n] = row >> halvings, column >> halvings, at
            w = np.float64(weight[entry])
            cluster = clusters[n]
            cluster[MOMENTS:] = w if shared else 0.0
            cluster[MOMENTS + channel] = w
            for c in range(MOMENTS, MOMENTS + 3):
                cluster[c + 3], cluster[c + 6] = cluster[c] * x[0], cluster[c] * y[0]
            w = (cluster[MOMENTS] + cluster[MOMENTS + 1] + cluster[MOMENTS + 2]) / 3
            cluster[0], cluster[1], cluster[2] = w, w * x[0], w * y[0]
            cluster[3], cluster[4], cluster[5] = w * x[1], w * x[0] * y[0], w * y[1]
            n, entry = n + 1, entry + 1
    return n, halvings


@njit(nogil=True, cache=True)
def _describe(cluster: NDArray[np.float64], lobe: NDArray[np.float32]) -> None:
    """Write a lobe from the raw moments and the weights of its cluster."""
    central = np.empty(MOMENTS)
    central_moments(cluster, central)
    _, x, y, xx, xy, yy = central
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    major, minor = math.sqrt(max(mean + half, 0.0)), math.sqrt(max(mean - half, 0.0))
    theta = 0.5 * math.atan2(2 * xy, xx - yy) if half > 1e-6 * mean else 0.0
    if abs(theta) > math.pi / 4:
        theta -= math.copysign(math.pi / 2, theta)
        major, minor = minor, major
    lobe[0], lobe[1] = x, y
    for channel in range(3):
        lobe[2 + channel] = cluster[MOMENTS + channel]
    lobe[5], lobe[6], lobe[7] = major, minor, theta
