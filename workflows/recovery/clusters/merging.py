"""The clusters that lobes are made from: their layout, and which of them merge."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

MOMENTS = 6
"""A cluster begins with its raw moments of order 0 to 2, see :func:`.gaussians.add_moments`."""
CLUSTER_VALUES = MOMENTS + 9
"""After its moments come the weights of the three channels, the same times x, and the same times y."""

_APART = 3.0
"""Clusters whose centres are farther apart than this many standard deviations of the wider one stay separate. The
halves of a Gaussian are 2.6 of their own standard deviations apart, so they merge."""
_FRINGE, _NO_COLOUR = 0.5, 0.05
"""Clusters stay separate if in their merger two channels' centres would be farther apart than `_FRINGE` standard
deviations. Channels with less than `_NO_COLOUR` of the light are ignored."""


@njit(nogil=True, cache=True)
def merge_squares(
    clusters: NDArray[np.float64],
    node: NDArray[np.int64],
    level: NDArray[np.int64],
    n: int,
) -> int:
    """Merge the clusters in each 2 x 2 square of a grid; return the number left, which come first.

    `node`, (n, 2), holds the row and column of each cluster on the grid of its `level`, and is halved.
    """
    key = np.empty(n, np.int64)
    for a in range(n):
        node[a, 0], node[a, 1] = node[a, 0] // 2, node[a, 1] // 2
        key[a] = (level[a] * 2**24 + node[a, 0]) * 2**24 + node[a, 1]
    order = np.argsort(key, kind="mergesort")
    old_clusters, old_node, old_level = clusters[:n].copy(), node[:n].copy(), level[:n].copy()
    left = -1
    for k in range(n):
        a = order[k]
        if k == 0 or key[a] != key[order[k - 1]]:
            left += 1
            clusters[left], node[left], level[left] = old_clusters[a], old_node[a], old_level[a]
        else:
            clusters[left] += old_clusters[a]
    return left + 1


@njit(nogil=True, cache=True)
def merge_near(
    clusters: NDArray[np.float64],
    level: NDArray[np.int64],
    n: int,
    least: NDArray[np.float64],
    shared: bool,
) -> int:
    """Merge clusters that overlap, at least cost first; return the number left, which come first.

    `least`, (levels,), is the least variance of a cluster by level. `shared` is true if all channels have the same
    weights. A merger gets the coarser of the two levels.
    """
    central = np.empty((n, MOMENTS))
    # for each cluster the cheapest to merge with among those after it
    partner, cost = np.empty(n, np.int64), np.empty(n)
    alive = np.ones(n, np.bool_)
    for a in range(n):
        central_moments(clusters[a], central[a])
    for a in range(n):
        partner[a], cost[a] = _find_partner(clusters, central, level, n, least, alive, a, shared)
    while True:
        a = -1
        for i in range(n):
            if alive[i] and cost[i] < np.inf and (a < 0 or cost[i] < cost[a]):
                a = i
        if a < 0:
            break
        b = partner[a]
        clusters[a] += clusters[b]
        central_moments(clusters[a], central[a])
        level[a] = max(level[a], level[b])
        alive[b] = False
        for i in range(n):
            if not alive[i]:
                continue
            if i == a or partner[i] == a or partner[i] == b:
                partner[i], cost[i] = _find_partner(clusters, central, level, n, least, alive, i, shared)
            elif i < a:
                new = _cost(central, level, least, i, a, cost[i])
                if new < cost[i] and (shared or not _has_fringes(clusters[i], clusters[a])):
                    partner[i], cost[i] = a, new
    left = 0
    for i in range(n):
        if alive[i]:
            clusters[left] = clusters[i]
            left += 1
    return left


@njit(nogil=True, cache=True)
def _find_partner(
    clusters: NDArray[np.float64],
    central: NDArray[np.float64],
    level: NDArray[np.int64],
    n: int,
    least: NDArray[np.float64],
    alive: NDArray[np.bool_],
    a: int,
    shared: bool,
) -> tuple[int, float]:
    """Find the cluster after `a` that is cheapest to merge with it, and the cost; -1 and infinity if there is none."""
    partner, cost = -1, np.inf
    for b in range(a + 1, n):
        if alive[b]:
            new = _cost(central, level, least, a, b, cost)
            if new < cost and (shared or not _has_fringes(clusters[a], clusters[b])):
                partner, cost = b, new
    return partner, cost


@njit(nogil=True, cache=True)
def _cost(
    central: NDArray[np.float64],
    level: NDArray[np.int64],
    least: NDArray[np.float64],
    a: int,
    b: int,
    most: float,
) -> float:
    """Ward's cost of merging two clusters; infinite if they must not merge or if it is not below `most`."""
    dx, dy = central[b, 1] - central[a, 1], central[b, 2] - central[a, 2]
    square = dx * dx + dy * dy
    cost: float = central[a, 0] * central[b, 0] / (central[a, 0] + central[b, 0]) * square
    if cost >= most or abs(level[a] - level[b]) > 1:
        return np.inf
    limit = square * square / _APART**2
    if square * max(least[level[a]], least[level[b]]) >= limit:
        return cost
    for c in (a, b):
        if dx * dx * central[c, 3] + 2 * dx * dy * central[c, 4] + dy * dy * central[c, 5] >= limit:
            return cost
    return np.inf


@njit(nogil=True, cache=True)
def _has_fringes(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether the channels' centres would differ in the merger of two clusters: it would lose colour fringes."""
    w = a[0] + b[0]
    x, y = (a[1] + b[1]) / w, (a[2] + b[2]) / w
    xx, yy = (a[3] + b[3]) / w - x * x, (a[5] + b[5]) / w - y * y
    xy = (a[4] + b[4]) / w - x * y
    for c in range(MOMENTS, MOMENTS + 3):
        for d in range(c + 1, MOMENTS + 3):
            wc, wd = a[c] + b[c], a[d] + b[d]
            if min(wc, wd) < _NO_COLOUR * 3 * w:
                continue
            dx = (a[d + 3] + b[d + 3]) / wd - (a[c + 3] + b[c + 3]) / wc
            dy = (a[d + 6] + b[d + 6]) / wd - (a[c + 6] + b[c + 6]) / wc
            square = dx * dx + dy * dy
            if square * square > _FRINGE**2 * (dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy):
                return True
    return False


@njit(nogil=True, cache=True)
def central_moments(cluster: NDArray[np.float64], central: NDArray[np.float64]) -> None:
    """Write the weight, the centre (x, y) and the central second moments (xx, xy, yy) of a cluster."""
    w = cluster[0]
    x, y = cluster[1] / w, cluster[2] / w
    central[0], central[1], central[2] = w, x, y
    central[3], central[4], central[5] = (
        cluster[3] / w - x * x,
        cluster[4] / w - x * y,
        cluster[5] / w - y * y,
    )
