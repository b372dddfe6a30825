"""T as a few lookups per pixel in a mipmapped texture, for compositing on graphics hardware.

The texture's levels are the grids of a :class:`~workflows.recovery.pyramid.Pyramid`. Lookups are trilinear: bilinear
between the nodes of a level, and linear between levels.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.layout.mattes import Block, Matte
from workflows.interruption import checkpoint
from workflows.mattes.lobes import transport_of
from workflows.recovery.pyramid import Pyramid, bump_variance
from workflows.recovery.transport import Transport

FIELDS = ("x", "y", "level", "R", "G", "B")
"""The values of a lookup, in this order."""
CLUSTERS = 24
"""Most clusters of a pixel that merge by Ward's cost, unless another number is asked for."""
_MOST_READ = 1 << 14
"""Clusters of a pixel that are held while its entries are read; if there are more, squares merge already then."""
_CHUNK = 64
"""Pixels between two checkpoints."""
_CLUSTER = 7
"""Values of a cluster: its weight w; w times x, y and the mean second moment of the axes; the channels' weights."""


def fit_lookups(
    transport: Transport, most: int, wanted: NDArray[np.bool_], clusters: int = CLUSTERS
) -> NDArray[np.float32]:
    """Approximate rows of T by a few texture lookups.

    Parameters
    ----------
    transport : Transport
        T of n pixels.
    most : int
        Lookups of a pixel.
    wanted : (n,) bool
        Pixels to process; the others get zeros.
    clusters : int
        Most clusters of a pixel that merge by Ward's cost. While there are more, those in each 2 x 2 square of a grid
        merge, which takes less time and is less exact.

    Returns
    -------
    (n, most, 6) float32
        Columns as in `FIELDS`: the position in cells of the first grid, from its top left, the level, and each
        channel's share of light. Heaviest lookup first; the rest is 0. The shares of a pixel sum to those of its rows.

    Notes
    -----
    Nodes merge by their moments, at least cost first (Ward, "Hierarchical grouping to optimize an objective function",
    J. Am. Stat. Assoc., 1963), until `most` clusters are left. A cluster is looked up at its centre, on the level
    where a lookup has the cluster's variance. In cells squared along each axis, a bump of level l has the variance
    ``b_l = 1/12 + (4^l - 1) / 4``, for [1, 3, 3, 1] / 8 on a grid of spacing s adds 3/4 s^2. A bilinear lookup at the
    fraction f between two nodes adds ``f (1 - f) 4^l``. A lookup between two levels interpolates their variances.
    A cluster of a single node is exact.
    """
    pyramid = Pyramid.over(transport.columns, transport.rows)
    cell, weight, shared = transport.cell, transport.weight, transport.shared
    sizes = transport.count.astype(np.int64)
    begin = np.concatenate([[0], np.cumsum(sizes.sum(axis=1))])
    capacity = min(max(int(np.diff(begin).max(initial=0)), 1), _MOST_READ)
    lookups = np.zeros((len(sizes), most, len(FIELDS)), np.float32)
    held, grid = np.empty((capacity, _CLUSTER)), (pyramid.starts, pyramid.arrays.columns)
    for first in range(0, len(sizes), _CHUNK):
        checkpoint()
        at = slice(first, first + _CHUNK)
        _fit(sizes[at], begin[at], wanted[at], shared[at], cell, weight, *grid, held, clusters, lookups[at])
    return lookups


def block_lookups(
    matte: Matte, block: Block, most: int, wanted: NDArray[np.bool_] | None = None, clusters: int = CLUSTERS
) -> NDArray[np.float32]:
    """The lookups of the pixels of a block, (h, w, most, 6), as of `fit_lookups`; by default of all pixels."""
    wanted = np.ones(block.recovered.shape, bool) if wanted is None else wanted
    found = fit_lookups(transport_of(matte, block), most, wanted.reshape(-1), clusters)
    return found.reshape(*block.recovered.shape, most, len(FIELDS))


@njit(nogil=True, cache=True)
def _fit(
    sizes: NDArray[np.int64],
    begin: NDArray[np.int64],
    wanted: NDArray[np.bool_],
    shared: NDArray[np.bool_],
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    starts: NDArray[np.int64],
    columns: NDArray[np.int64],
    clusters: NDArray[np.float64],
    most_clusters: int,
    lookups: NDArray[np.float32],
) -> None:
    """Write the lookups of one pixel after another."""
    capacity = len(clusters)
    key, copy = np.empty(capacity, np.int64), np.empty((capacity, _CLUSTER))
    partner, cost = np.empty(capacity, np.int64), np.empty(capacity)
    for i in np.flatnonzero(wanted):
        n = _read_clusters(sizes[i], begin[i], shared[i], cell, weight, starts, columns, clusters, key, copy)
        if not shared[i]:  # the channels' rows have many nodes in common
            n = _merge_equal(clusters, key, n, copy)
        n = _merge_squares(clusters, key, n, most_clusters, copy)
        n = _merge_nearest(clusters, partner, cost, n, lookups.shape[1])
        for k in range(n):
            heaviest = k
            for other in range(k + 1, n):
                if clusters[other, 0] > clusters[heaviest, 0]:
                    heaviest = other
            _describe(clusters[heaviest], len(columns) - 1, lookups[i, k])
            clusters[heaviest] = clusters[k]


@njit(nogil=True, cache=True)
def _read_clusters(
    sizes: NDArray[np.int64],
    entry: int,
    shared: bool,
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    starts: NDArray[np.int64],
    columns: NDArray[np.int64],
    clusters: NDArray[np.float64],
    key: NDArray[np.int64],
    copy: NDArray[np.float64],
) -> int:
    """Write a cluster for each entry of a pixel's rows, and its level, row and column as a key; return their number.

    `sizes`, (3,), are the entries of each channel; the first is `entry`. If there is no room for all, squares merge.
    """
    n, halvings = 0, 0
    for channel in range(3):
        for _ in range(sizes[channel]):
            if n == len(clusters):
                while n > len(clusters) // 2:
                    n = _halve(clusters, key, n, copy)
                    halvings += 1
            level = np.searchsorted(starts, cell[entry], "right") - 1
            row, column = divmod(np.int64(cell[entry]) - starts[level], columns[level])
            side = 2.0**level
            x, y = (column + 0.5) * side, (row + 0.5) * side
            w = np.float64(weight[entry])
            cluster = clusters[n]
            cluster[4:] = w if shared else 0.0
            cluster[4 + channel] = w
            w = cluster[4] + cluster[5] + cluster[6]
            cluster[0], cluster[1], cluster[2] = w, w * x, w * y
            cluster[3] = w * ((x * x + y * y) / 2 + bump_variance(level))
            key[n] = (level * 2**24 + (row >> halvings)) * 2**24 + (column >> halvings)
            n, entry = n + 1, entry + 1
    return n


@njit(nogil=True, cache=True)
def _merge_squares(
    clusters: NDArray[np.float64], key: NDArray[np.int64], n: int, most: int, copy: NDArray[np.float64]
) -> int:
    """Merge clusters in each 2 x 2 square of a grid until there are few; return the number left, which come first."""
    while n > most:
        left = _halve(clusters, key, n, copy)
        if left == n and (key[:n] % 2**48 == 0).all():
            break  # one cluster per level
        n = left
    return n


@njit(nogil=True, cache=True)
def _halve(clusters: NDArray[np.float64], key: NDArray[np.int64], n: int, copy: NDArray[np.float64]) -> int:
    """Merge clusters in each 2 x 2 square of a grid once; return the number left, which come first."""
    for a in range(n):
        level, node = divmod(key[a], 2**48)
        row, column = divmod(node, 2**24)
        key[a] = (level * 2**24 + row // 2) * 2**24 + column // 2
    left: int = _merge_equal(clusters, key, n, copy)
    return left


@njit(nogil=True, cache=True)
def _merge_equal(
    clusters: NDArray[np.float64], key: NDArray[np.int64], n: int, copy: NDArray[np.float64]
) -> int:
    """Merge clusters of equal keys; return the number left, which come first. `copy` is working space."""
    order = np.argsort(key[:n], kind="mergesort")
    copy[:n] = clusters[:n]
    keys = key[:n].copy()
    left = -1
    for k in range(n):
        a = order[k]
        if k == 0 or keys[a] != key[left]:
            left += 1
            key[left] = keys[a]
            clusters[left] = copy[a]
        else:
            clusters[left] += copy[a]
    return left + 1


@njit(nogil=True, cache=True)
def _merge_nearest(
    clusters: NDArray[np.float64], partner: NDArray[np.int64], cost: NDArray[np.float64], n: int, most: int
) -> int:
    """Merge clusters, at least cost first, until no more than `most` are left; return the number left.

    `partner` and `cost`, (n,), are working space.
    """
    for a in range(n if n > most else 0):
        partner[a], cost[a] = _find_partner(clusters, n, a)
    while n > most:
        a = 0
        for i in range(1, n - 1):
            if cost[i] < cost[a]:
                a = i
        b = partner[a]
        clusters[a] += clusters[b]
        n -= 1
        clusters[b] = clusters[n]
        partner[b], cost[b] = partner[n], cost[n]
        for i in range(n):
            if i in (a, b) or partner[i] in (a, b, n):
                partner[i], cost[i] = _find_partner(clusters, n, i)
            else:
                for other in (a, b):
                    if other > i:
                        new = _cost(clusters[i], clusters[other])
                        if new < cost[i]:
                            partner[i], cost[i] = other, new
    return n


@njit(nogil=True, cache=True)
def _find_partner(clusters: NDArray[np.float64], n: int, a: int) -> tuple[int, float]:
    """Find the cluster after `a` that is cheapest to merge with it, and the cost."""
    partner, cost = -1, np.inf
    for b in range(a + 1, n):
        new = _cost(clusters[a], clusters[b])
        if new < cost:
            partner, cost = b, new
    return partner, cost


@njit(nogil=True, cache=True)
def _cost(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Ward's cost of merging two clusters."""
    wa, wb = a[0], b[0]
    dx, dy = a[1] / wa - b[1] / wb, a[2] / wa - b[2] / wb
    cost: float = wa * wb / (wa + wb) * (dx * dx + dy * dy)
    return cost


@njit(nogil=True, cache=True)
def _variance_of_lookup(x: float, y: float, level: int) -> float:
    """Variance of a lookup at a position in cells, in cells squared, the mean of both axes."""
    side = 2.0**level
    f, g = x / side - 0.5, y / side - 0.5
    f, g = f - math.floor(f), g - math.floor(g)
    variance: float = bump_variance(level) + side * side * (f * (1 - f) + g * (1 - g)) / 2
    return variance


@njit(nogil=True, cache=True)
def _describe(cluster: NDArray[np.float64], last: int, lookup: NDArray[np.float32]) -> None:
    """Write the lookup of a cluster; `last` is the coarsest level."""
    w = cluster[0]
    x, y = cluster[1] / w, cluster[2] / w
    variance = cluster[3] / w - (x * x + y * y) / 2
    level, finer = 0, _variance_of_lookup(x, y, 0)
    fraction = 0.0
    while level < last:
        coarser = _variance_of_lookup(x, y, level + 1)
        if coarser > variance:
            fraction = min(max((variance - finer) / (coarser - finer), 0.0), 1.0) if coarser > finer else 0.0
            break
        level, finer = level + 1, coarser
    lookup[0], lookup[1], lookup[2] = x, y, level + fraction
    lookup[3:] = cluster[4:]
