"""The lobes of every pixel, heaviest first: the rows of a T as a few Gaussians that other tools can work with."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.clusters import merge_clusters
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.transport import Transport

FIELDS = ("u", "v", "weight.R", "weight.G", "weight.B", "sigma_u", "sigma_v", "theta")
"""The columns of a lobe table."""

_APART = 3.0
"""Clusters are lobes of their own where their centres are further apart than this many standard deviations of the
wider one. The two halves of a Gaussian are 2.6 of their own apart, and so stay together."""
_SPACING = 0.5
"""Standard deviation of a node in spacings of its grid, at least: neighbours, and on the diagonal, are not apart."""
_CLUSTERS, _WIDEST = 32, 4.0**6
"""A pixel of more nodes than these has those of two by two places of a grid merged first, which are not apart, and then
again, so many times at most."""
_FRINGE, _NO_COLOUR = 0.5, 0.05
"""Standard deviations that the channels' own centres in a lobe may be apart; one of less of the light has no say."""
_MOMENTS = 6
"""Of order 0 to 2, as :func:`~workflows.recovery.clusters.add_moments` has them; the weights of the channels come after
them, and these times x, and times y."""


def ranked_lobes(transport: Transport, most: int, aspect: float) -> NDArray[np.float32]:
    """The lobes of each pixel.

    Parameters
    ----------
    transport : Transport
        Of n pixels.
    most : int
        Lobes of a pixel, at most.
    aspect : float
        Height of the monitor as a share of its width.

    Returns
    -------
    (n, most, 8) float32
        By `FIELDS`; heaviest first, by the mean weight of the channels. All 0 where there are fewer.

        - ``u``, ``v``: the centre, 0 to 1 over the monitor, u to the right and v up, from its bottom left corner. The
          centre of the monitor's pixel (x, y), y down, is ((x + 0.5) / width, 1 - (y + 0.5) / height).
        - ``weight``: the lobe's share of a channel's light; those of a pixel sum to 1 in each channel.
        - ``sigma_u``, ``sigma_v``: standard deviations along the axes of its ellipse, both in units of the monitor's
          width, so that they and the angle are those seen on the monitor. Its cells' own extent is in them.
        - ``theta``: angle in radians, counter-clockwise, from the u axis to the axis of ``sigma_u``, -pi/4 to pi/4:
          ``sigma_u`` is along the axis that is nearer to u, however the ellipse lies.

    Raises
    ------
    ValueError
        If `most` or `aspect` is not positive.

    Notes
    -----
    A node is a cluster with the mean and the variance of its bump, edges included. Clusters merge by their moments:
    first the two that cost least (Ward, see :func:`~workflows.recovery.clusters.merge_clusters`) among those that
    are not apart and whose grids are the same or neighbours, for a sharp lobe on a broad one is another; then, if more
    than `most` are left, whichever cost least. The rows of a pixel are one set, so that a lobe has one place and three
    weights; colours that come from different places are lobes apart, even where they touch.

    In the monitor's plane, ``(u, v aspect)``, a lobe's covariance is ``R diag(sigma_u^2, sigma_v^2) R^T``, R the
    rotation by theta.
    """
    if most < 1 or not aspect > 0:
        raise ValueError("a pixel has at least one lobe, and a monitor some height")
    pyramid = Pyramid.over(transport.columns, transport.rows)
    columns, rows, starts = pyramid.arrays
    x, y = pyramid.axis_moments(0), pyramid.axis_moments(1)
    across = np.stack([x[:, 0] / transport.columns, x[:, 1] / transport.columns**2], axis=1)
    down = y / [transport.rows, transport.rows**2]
    up = np.stack([1 - down[:, 0], 1 - 2 * down[:, 0] + down[:, 1]], axis=1) * [aspect, aspect**2]
    sizes = transport.count.astype(np.int64)
    begin = np.concatenate([[0], np.cumsum(sizes.sum(axis=1))])
    spacing = max(1 / transport.columns, aspect / transport.rows) * 2.0 ** np.arange(len(columns))
    lobes = np.zeros((len(sizes), most, len(FIELDS)), np.float32)
    room = int(np.diff(begin).max(initial=0))
    _rank(
        sizes,
        begin,
        transport.cell.astype(np.int64),
        transport.weight,
        transport.shared,
        starts,
        columns,
        np.concatenate([[0], np.cumsum(columns)]),
        np.concatenate([[0], np.cumsum(rows)]),
        across,
        up,
        (_SPACING * spacing) ** 2,
        np.empty((room, _MOMENTS + 9)),
        lobes,
    )
    lobes[..., 1] /= np.float32(aspect)
    return lobes


@njit(nogil=True, cache=True)
def _rank(
    sizes: NDArray[np.int64],
    begin: NDArray[np.int64],
    cell: NDArray[np.int64],
    weight: NDArray[np.float32],
    shared: NDArray[np.bool_],
    starts: NDArray[np.int64],
    columns: NDArray[np.int64],
    first_column: NDArray[np.int64],
    first_row: NDArray[np.int64],
    across: NDArray[np.float64],
    up: NDArray[np.float64],
    least: NDArray[np.float64],
    clusters: NDArray[np.float64],
    lobes: NDArray[np.float32],
) -> None:
    """Write the lobes of pixel after pixel, v in units of the monitor's width."""
    node, level = np.empty((len(clusters), 2), np.int64), np.empty(len(clusters), np.int64)
    for i in range(len(sizes)):
        n, entry = 0, begin[i]
        for channel in range(3):
            for _ in range(sizes[i, channel]):
                at = np.searchsorted(starts, cell[entry], "right") - 1
                row, column = divmod(cell[entry] - starts[at], columns[at])
                x, y = across[first_column[at] + column], up[first_row[at] + row]
                node[n, 0], node[n, 1], level[n] = row, column, at
                w = np.float64(weight[entry])
                to = clusters[n]
                to[_MOMENTS:] = w if shared[i] else 0.0
                to[_MOMENTS + channel] = w
                for c in range(_MOMENTS, _MOMENTS + 3):
                    to[c + 3], to[c + 6] = to[c] * x[0], to[c] * y[0]
                w = (to[_MOMENTS] + to[_MOMENTS + 1] + to[_MOMENTS + 2]) / 3
                to[0], to[1], to[2] = w, w * x[0], w * y[0]
                to[3], to[4], to[5] = w * x[1], w * x[0] * y[0], w * y[1]
                n, entry = n + 1, entry + 1
        widening = 1.0
        while n > _CLUSTERS and widening < _WIDEST:
            n = _merge_squares(clusters, node, level, n)
            widening *= 4
        n = _merge_near(clusters, level, n, least * widening, shared[i])
        n = merge_clusters(clusters, n, lobes.shape[1])
        for k in range(n):
            heaviest = k
            for other in range(k + 1, n):
                if clusters[other, 0] > clusters[heaviest, 0]:
                    heaviest = other
            _describe(clusters[heaviest], lobes[i, k])
            clusters[heaviest] = clusters[k]


@njit(nogil=True, cache=True)
def _merge_squares(
    clusters: NDArray[np.float64],
    node: NDArray[np.int64],
    level: NDArray[np.int64],
    n: int,
) -> int:
    """Merge the clusters of each two by two places of a grid; returns how many are left, at the front."""
    key = np.empty(n, np.int64)
    for a in range(n):
        node[a, 0], node[a, 1] = node[a, 0] // 2, node[a, 1] // 2
        key[a] = (level[a] * 2**24 + node[a, 0]) * 2**24 + node[a, 1]
    order = np.argsort(key, kind="mergesort")
    was, place, at = clusters[:n].copy(), node[:n].copy(), level[:n].copy()
    left = -1
    for k in range(n):
        a = order[k]
        if k == 0 or key[a] != key[order[k - 1]]:
            left += 1
            clusters[left], node[left], level[left] = was[a], place[a], at[a]
        else:
            clusters[left] += was[a]
    return left + 1


@njit(nogil=True, cache=True)
def _merge_near(
    clusters: NDArray[np.float64],
    level: NDArray[np.int64],
    n: int,
    least: NDArray[np.float64],
    shared: bool,
) -> int:
    """Merge clusters that are not apart, cheapest first; returns how many are left, at the front."""
    about = np.empty((n, _MOMENTS))
    # Of each cluster the cheapest to merge with among those behind it.
    partner, cost = np.empty(n, np.int64), np.empty(n)
    alive = np.ones(n, np.bool_)
    for a in range(n):
        _centre(clusters[a], about[a])
    for a in range(n):
        partner[a], cost[a] = _find_partner(clusters, about, level, n, least, alive, a, shared)
    while True:
        a = -1
        for i in range(n):
            if alive[i] and cost[i] < np.inf and (a < 0 or cost[i] < cost[a]):
                a = i
        if a < 0:
            break
        b = partner[a]
        clusters[a] += clusters[b]
        _centre(clusters[a], about[a])
        level[a] = max(level[a], level[b])
        alive[b] = False
        for i in range(n):
            if not alive[i]:
                continue
            if i == a or partner[i] == a or partner[i] == b:
                partner[i], cost[i] = _find_partner(clusters, about, level, n, least, alive, i, shared)
            elif i < a:
                now = _cost(about, level, least, i, a, cost[i])
                if now < cost[i] and (shared or not _fringes(clusters[i], clusters[a])):
                    partner[i], cost[i] = a, now
    left = 0
    for i in range(n):
        if alive[i]:
            clusters[left] = clusters[i]
            left += 1
    return left


@njit(nogil=True, cache=True)
def _find_partner(
    clusters: NDArray[np.float64],
    about: NDArray[np.float64],
    level: NDArray[np.int64],
    n: int,
    least: NDArray[np.float64],
    alive: NDArray[np.bool_],
    a: int,
    shared: bool,
) -> tuple[int, float]:
    """Which cluster behind one is the cheapest to merge with it, and at what cost: infinite if none is near."""
    partner, cost = -1, np.inf
    for b in range(a + 1, n):
        if alive[b]:
            now = _cost(about, level, least, a, b, cost)
            if now < cost and (shared or not _fringes(clusters[a], clusters[b])):
                partner, cost = b, now
    return partner, cost


@njit(nogil=True, cache=True)
def _cost(
    about: NDArray[np.float64],
    level: NDArray[np.int64],
    least: NDArray[np.float64],
    a: int,
    b: int,
    most: float,
) -> float:
    """Ward's cost of merging two clusters; infinite if they may not, or if it is more than there is use for."""
    dx, dy = about[b, 1] - about[a, 1], about[b, 2] - about[a, 2]
    square = dx * dx + dy * dy
    cost: float = about[a, 0] * about[b, 0] / (about[a, 0] + about[b, 0]) * square
    if cost >= most or abs(level[a] - level[b]) > 1:
        return np.inf
    limit = square * square / _APART**2
    if square * max(least[level[a]], least[level[b]]) >= limit:
        return cost
    for c in (a, b):
        if dx * dx * about[c, 3] + 2 * dx * dy * about[c, 4] + dy * dy * about[c, 5] >= limit:
            return cost
    return np.inf


@njit(nogil=True, cache=True)
def _fringes(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether the channels would lie apart in the merger of two clusters, which would take the colours off an edge."""
    w = one[0] + other[0]
    x, y = (one[1] + other[1]) / w, (one[2] + other[2]) / w
    xx, yy = (one[3] + other[3]) / w - x * x, (one[5] + other[5]) / w - y * y
    xy = (one[4] + other[4]) / w - x * y
    for c in range(_MOMENTS, _MOMENTS + 3):
        for d in range(c + 1, _MOMENTS + 3):
            wc, wd = one[c] + other[c], one[d] + other[d]
            if min(wc, wd) < _NO_COLOUR * 3 * w:
                continue
            dx = (one[d + 3] + other[d + 3]) / wd - (one[c + 3] + other[c + 3]) / wc
            dy = (one[d + 6] + other[d + 6]) / wd - (one[c + 6] + other[c + 6]) / wc
            square = dx * dx + dy * dy
            if square * square > _FRINGE**2 * (dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy):
                return True
    return False


@njit(nogil=True, cache=True)
def _centre(cluster: NDArray[np.float64], about: NDArray[np.float64]) -> None:
    """Write the weight, the centre and the moments about it."""
    w = cluster[0]
    x, y = cluster[1] / w, cluster[2] / w
    about[0], about[1], about[2] = w, x, y
    about[3], about[4], about[5] = cluster[3] / w - x * x, cluster[4] / w - x * y, cluster[5] / w - y * y


@njit(nogil=True, cache=True)
def _describe(cluster: NDArray[np.float64], lobe: NDArray[np.float32]) -> None:
    """Write a lobe from its raw moments and its weights."""
    about = np.empty(_MOMENTS)
    _centre(cluster, about)
    _, x, y, xx, xy, yy = about
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    major, minor = math.sqrt(max(mean + half, 0.0)), math.sqrt(max(mean - half, 0.0))
    theta = 0.5 * math.atan2(2 * xy, xx - yy) if half > 1e-6 * mean else 0.0
    if abs(theta) > math.pi / 4:
        theta -= math.copysign(math.pi / 2, theta)
        major, minor = minor, major
    lobe[0], lobe[1] = x, y
    for channel in range(3):
        lobe[2 + channel] = cluster[_MOMENTS + channel]
    lobe[5], lobe[6], lobe[7] = major, minor, theta
