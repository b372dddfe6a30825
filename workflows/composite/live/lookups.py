"""T as a few lookups a pixel in a mip-mapped texture: what graphics hardware evaluates while a hand moves a backdrop.

The texture's levels are the grids of a :class:`~workflows.recovery.pyramid.Pyramid`. A lookup between nodes is
bilinear, one between levels linear.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.pyramid import Pyramid

FIELDS = ("x", "y", "level", "R", "G", "B")
"""The values of a lookup, in this order."""
_FEW = 24
"""Clusters of a pixel that are merged by their distances; of more, neighbours on a grid are merged first."""
_MOMENTS, _CLUSTER = 4, 7
"""Of a cluster: weight, times x, times y, times the mean of the axes' second moments; and the channels' weights."""


def fit_lookups(
    columns: int,
    rows: int,
    count: NDArray[np.uint32],
    shared: NDArray[np.bool_],
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    most: int,
    wanted: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """The rows of a T as few lookups.

    Parameters
    ----------
    columns, rows : int
        The first grid of the cells.
    count, shared, cell, weight : arrays
        Of n pixels, as :class:`~storage.layout.mattes.Block` has them: (n, 3), (n,), and one after another.
    most : int
        Lookups of a pixel.
    wanted : (n,) bool
        Of which pixels; the others get none.

    Returns
    -------
    (n, most, 6) float32
        By `FIELDS`, heaviest first and zeros where there are fewer: the place in cells of the first grid, from its top
        left, the level, and each channel's share of light. The shares of a pixel sum to what its row does.

    Notes
    -----
    Nodes merge, by their moments, always the two of which the merger moves the least light (Ward, "Hierarchical
    grouping to optimize an objective function", J. Am. Stat. Assoc., 1963), until there are `most`. What is left is
    looked up at its centre, on the level whose lookup there has the same variance: a bump of level l has
    ``b_l = 1/12 + (4^l - 1) / 4`` cells squared along each axis ([1, 3, 3, 1] / 8 on a grid of spacing s adds
    3/4 s^2), a bilinear lookup a share f of the spacing from a node ``f (1 - f) 4^l`` more, and one between two levels
    what lies between theirs. One node is so looked up as what it is.
    """
    pyramid = Pyramid.over(columns, rows)
    sizes = count.astype(np.int64)
    begin = np.concatenate([[0], np.cumsum(sizes.sum(axis=1))])
    room = max(int(np.diff(begin).max(initial=0)), 1)
    lookups = np.zeros((len(sizes), most, len(FIELDS)), np.float32)
    clusters = np.empty((room, _CLUSTER))
    _fit(
        sizes, begin, wanted, shared, cell, weight, pyramid.starts, pyramid.arrays.columns, clusters, lookups
    )
    return lookups


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
    lookups: NDArray[np.float32],
) -> None:
    """Write the lookups of pixel after pixel."""
    room = len(clusters)
    key, was = np.empty(room, np.int64), np.empty((room, _CLUSTER))
    partner, cost = np.empty(room, np.int64), np.empty(room)
    for i in np.flatnonzero(wanted):
        n, entry = 0, begin[i]
        for channel in range(3):
            for _ in range(sizes[i, channel]):
                level = np.searchsorted(starts, cell[entry], "right") - 1
                row, column = divmod(np.int64(cell[entry]) - starts[level], columns[level])
                side = 2.0**level
                x, y = (column + 0.5) * side, (row + 0.5) * side
                w = np.float64(weight[entry])
                to = clusters[n]
                to[4:] = w if shared[i] else 0.0
                to[4 + channel] = w
                w = to[4] + to[5] + to[6]
                to[0], to[1], to[2] = w, w * x, w * y
                to[3] = w * ((x * x + y * y) / 2 + _variance(level))
                key[n] = (level * 2**24 + row) * 2**24 + column
                n, entry = n + 1, entry + 1
        if not shared[i]:  # the channels' rows have many nodes in common
            n = _merge_equal(clusters, key, n, was)
        while n > _FEW:
            for a in range(n):
                level, place = divmod(key[a], 2**48)
                row, column = divmod(place, 2**24)
                key[a] = (level * 2**24 + row // 2) * 2**24 + column // 2
            left = _merge_equal(clusters, key, n, was)
            if left == n and (key[:n] % 2**48 == 0).all():
                break  # a cluster a grid
            n = left
        n = _merge_nearest(clusters, partner, cost, n, lookups.shape[1])
        for k in range(n):
            heaviest = k
            for other in range(k + 1, n):
                if clusters[other, 0] > clusters[heaviest, 0]:
                    heaviest = other
            _describe(clusters[heaviest], len(columns) - 1, lookups[i, k])
            clusters[heaviest] = clusters[k]


@njit(nogil=True, cache=True)
def _merge_equal(
    clusters: NDArray[np.float64], key: NDArray[np.int64], n: int, was: NDArray[np.float64]
) -> int:
    """Merge clusters of one key; returns how many are left, at the front."""
    order = np.argsort(key[:n], kind="mergesort")
    was[:n] = clusters[:n]
    keys = key[:n].copy()
    left = -1
    for k in range(n):
        a = order[k]
        if k == 0 or keys[a] != key[left]:
            left += 1
            key[left] = keys[a]
            clusters[left] = was[a]
        else:
            clusters[left] += was[a]
    return left + 1


@njit(nogil=True, cache=True)
def _merge_nearest(
    clusters: NDArray[np.float64], partner: NDArray[np.int64], cost: NDArray[np.float64], n: int, most: int
) -> int:
    """Merge clusters until there are no more than `most`, cheapest first; returns how many are left."""
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
        clusters[b] = clusters[n]  # the last one takes its place
        partner[b], cost[b] = partner[n], cost[n]
        for i in range(n):
            if i in (a, b) or partner[i] in (a, b, n):
                partner[i], cost[i] = _find_partner(clusters, n, i)
            else:
                for other in (a, b):
                    if other > i:
                        now = _cost(clusters[i], clusters[other])
                        if now < cost[i]:
                            partner[i], cost[i] = other, now
    return n


@njit(nogil=True, cache=True)
def _find_partner(clusters: NDArray[np.float64], n: int, a: int) -> tuple[int, float]:
    """Which cluster behind one is the cheapest to merge with it, and at what cost."""
    partner, cost = -1, np.inf
    for b in range(a + 1, n):
        now = _cost(clusters[a], clusters[b])
        if now < cost:
            partner, cost = b, now
    return partner, cost


@njit(nogil=True, cache=True)
def _cost(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """How much it moves light to merge two clusters."""
    wa, wb = one[0], other[0]
    dx, dy = one[1] / wa - other[1] / wb, one[2] / wa - other[2] / wb
    cost: float = wa * wb / (wa + wb) * (dx * dx + dy * dy)
    return cost


@njit(nogil=True, cache=True)
def _variance(level: int) -> float:
    """Of a bump, in cells squared along an axis."""
    variance: float = 1 / 12 + (4.0**level - 1) / 4
    return variance


@njit(nogil=True, cache=True)
def _variance_of_lookup(x: float, y: float, level: int) -> float:
    """Of a lookup at a place in cells on a level, the mean of the axes."""
    side = 2.0**level
    f, g = x / side - 0.5, y / side - 0.5
    f, g = f - math.floor(f), g - math.floor(g)
    variance: float = _variance(level) + side * side * (f * (1 - f) + g * (1 - g)) / 2
    return variance


@njit(nogil=True, cache=True)
def _describe(cluster: NDArray[np.float64], last: int, lookup: NDArray[np.float32]) -> None:
    """Write a lookup from a cluster's moments."""
    w = cluster[0]
    x, y = cluster[1] / w, cluster[2] / w
    wanted = cluster[3] / w - (x * x + y * y) / 2
    level, here = 0, _variance_of_lookup(x, y, 0)
    further = 0.0
    while level < last:
        above = _variance_of_lookup(x, y, level + 1)
        if above > wanted:
            further = min(max((wanted - here) / (above - here), 0.0), 1.0) if above > here else 0.0
            break
        level, here = level + 1, above
    lookup[0], lookup[1], lookup[2] = x, y, level + further
    lookup[3:] = cluster[4:]
