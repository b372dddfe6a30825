"""Sampling of an oriented Gaussian lobe on the nodes of a pyramid, and the patterns' values on these nodes.

A lobe has the parameters (weight, x, y, l00, l10, l11). Its centre is in cells of the pyramid's first grid, from the
top left corner. L = [[l00, 0], [l10, l11]] is the Cholesky factor of its covariance less that of the bumps it is
sampled on. A lobe is sampled on the coarsest grid that resolves it.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.pyramid import Grids, bump_variance

PARAMETERS = 6
"""Parameters of a lobe."""
NODES = 1024
"""Most nodes that a lobe is sampled on. A lobe too long for that goes to a coarser grid."""

# Squared Mahalanobis distance at which a lobe is cut off: 0.7 % of its mass is beyond.
_REACH = 10.0
# Least standard deviation of a sampled Gaussian, in spacings of its grid. Below 0.3 it can miss all nodes. At 0.6 light
# from a single cell is explained so badly that a second place is not worth a lobe; at 0.4 fits end in wrong places.
_LEAST_SIGMA = 0.5


class PatternCodes(NamedTuple):
    """The patterns behind the measurements of a pixel.

    Attributes
    ----------
    grids : Grids
        The pyramid's grids.
    code : (nodes, first + groups * m or more) uint8
        Light, 0 (black) to 255 (white), on the nodes of the pyramid.
    first : int
        The column of `code` with the first pattern.
    groups, m : int
        Groups of measurements, and patterns of each group.
    strays : (s, m + 2) float32
        Light that does not come from the patterns, as it would be measured: first a constant, 1, then what else changes
        from frame to frame, as the border of a film does.
    dispersed : bool
        Whether red's and blue's lobes lie apart from green's; there are three groups then.
    """

    grids: Grids
    code: NDArray[np.uint8]
    first: int
    groups: int
    m: int
    strays: NDArray[np.float32]
    dispersed: bool


@njit(nogil=True, cache=True, inline="always")
def parts_of(patterns: PatternCodes) -> tuple[int, int]:
    """Into how many parts the groups fall that see lobes at the same places, and how many groups are in each."""
    return (patterns.groups, 1) if patterns.dispersed else (1, patterns.groups)


@njit(nogil=True, cache=True)
def fit_level(lobe: NDArray[np.float64], level: int, columns: NDArray[np.int64], resolution: float) -> int:
    """Move a lobe to the level that resolves it.

    Parameters
    ----------
    lobe : (6,) float64
        Changed in place: L, so that the covariance of the lobe including its bumps stays the same.
    level : int
        Its present level.
    columns : (levels,) int64
        Columns of the pyramid's grids.
    resolution : float
        Least standard deviation of the lobe along its minor axis, in spacings of the grid.

    Returns
    -------
    int
        Its new level.
    """
    blur = bump_variance(level)
    xx = lobe[3] ** 2 + blur
    xy = lobe[3] * lobe[4]
    yy = lobe[4] ** 2 + lobe[5] ** 2 + blur
    mean, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    minor, major = math.sqrt(max(mean - half, 1e-3)), math.sqrt(mean + half)
    level = 0
    while level < columns.size - 1:
        spacing = 2.0**level
        crowded = math.pi * _REACH * minor * major > NODES * 0.9 * spacing**2
        if minor < 2 * resolution * spacing and not crowded:
            break
        level += 1
    blur, least = bump_variance(level), (_LEAST_SIGMA * 2.0**level) ** 2
    low, high = max(mean - half - blur, least), max(mean + half - blur, least)
    cosine, sine = ((xx - yy) / 2 / half, xy / half) if half > 1e-9 else (1.0, 0.0)
    xx, xy = (low + high + (high - low) * cosine) / 2, (high - low) * sine / 2
    yy = low + high - xx
    lobe[3] = math.sqrt(xx)
    lobe[4] = xy / lobe[3]
    lobe[5] = math.sqrt(max(yy - lobe[4] ** 2, 1e-3))
    return level


@njit(nogil=True, cache=True)
def sample(
    lobe: NDArray[np.float64],
    level: int,
    grids: Grids,
    node: NDArray[np.int64],
    terms: NDArray[np.float32],
) -> int:
    """Write the nodes under a lobe, and its share on each.

    Parameters
    ----------
    lobe : (6,) float64
    level : int
    grids : Grids
    node : (NODES,) int64
        Written.
    terms : (1 or 6, NODES) float32
        Written: shares of sum 1, and their derivatives by x, y, l00, l10 and l11, of sum 0.

    Returns
    -------
    int
        The number of nodes, at least 1.

    Notes
    -----
    With z = L^-1 (node - centre), ln share = -z'z / 2 + const, and d ln share = z' L^-1 (d centre + dL z). Along a row
    ln share is a parabola, so the ratio of a share to the one before changes by a constant factor from node to node.
    """
    columns, rows, start = grids.columns[level], grids.rows[level], grids.starts[level]
    spacing = 2.0**level
    x, y, l00, l10, l11 = lobe[1], lobe[2], lobe[3], lobe[4], lobe[5]
    yy = l10**2 + l11**2
    slope, across = l00 * l10 / yy, l00 * l11 / math.sqrt(yy)
    tall = math.sqrt(_REACH * yy)
    top = max(0, math.ceil((y - tall) / spacing - 0.5))
    bottom = min(rows - 1, math.floor((y + tall) / spacing - 0.5))
    inverse0, inverse1 = 1 / l00, 1 / l11
    # from a node to the next of its row
    step0 = spacing / l00
    step1 = -l10 * step0 / l11
    bend = math.exp(-(step0 * step0 + step1 * step1))
    n, total = 0, 0.0
    for row in range(top, bottom + 1):
        dy = (row + 0.5) * spacing - y
        wide = across * math.sqrt(max(_REACH - dy * dy / yy, 0.0))
        left = max(0, math.ceil((x + slope * dy - wide) / spacing - 0.5))
        right = min(columns - 1, math.floor((x + slope * dy + wide) / spacing - 0.5))
        z0 = ((left + 0.5) * spacing - x) / l00
        z1 = (dy - l10 * z0) / l11
        share = math.exp(-(z0 * z0 + z1 * z1) / 2)
        ratio = math.exp(-(z0 * step0 + z1 * step1)) * math.sqrt(bend)
        for column in range(left, min(right + 1, left + NODES - n)):
            node[n] = start + row * columns + column
            terms[0, n] = share
            if terms.shape[0] > 1:
                g1 = z1 * inverse1
                g0 = (z0 - l10 * g1) * inverse0
                terms[1, n], terms[2, n] = g0, g1
                terms[3, n], terms[4, n], terms[5, n] = g0 * z0, g1 * z0, g1 * z1
            total += share
            n += 1
            z0, z1 = z0 + step0, z1 + step1
            share *= ratio
            ratio *= bend
    if n == 0:
        column = min(max(math.floor(x / spacing), 0), columns - 1)
        row = min(max(math.floor(y / spacing), 0), rows - 1)
        node[0] = start + row * columns + column
        for k in range(terms.shape[0]):
            terms[k, 0] = 1.0 if k == 0 else 0.0
        return 1
    _normalise(terms, n, total)
    return n


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc"})
def _normalise(terms: NDArray[np.float32], n: int, total: float) -> None:
    """Divide n shares by their sum `total`, and turn derivatives of their logarithms into derivatives of the shares."""
    for i in range(n):
        terms[0, i] /= total
    for k in range(1, terms.shape[0]):
        mean = np.float32(0)
        for i in range(n):
            mean += terms[0, i] * terms[k, i]
        for i in range(n):
            terms[k, i] = terms[0, i] * (terms[k, i] - mean)


@njit(nogil=True, cache=True)
def signed_codes(
    code: NDArray[np.uint8],
    first: int,
    m: int,
    node: NDArray[np.int64],
    n: int,
    out: NDArray[np.float32],
    to: int,
) -> None:
    """Write the patterns' light on some nodes, -1 (black) to 1 (white), one row per node.

    Parameters
    ----------
    code : (nodes, first + m or more) uint8
        Light, 0 to 255.
    first, m : int
        The first column of `code` to read, and the number of columns.
    node : (n or more,) int64
    n : int
    out : (n or more, to + m or more) float32
        Written.
    to : int
        The first column of `out` to write.
    """
    for i in range(n):
        row, written = code[node[i]][first : first + m], out[i][to : to + m]
        for k in range(m):
            written[k] = np.float32(row[k]) * np.float32(2 / 255) - np.float32(1)


# "contract" allows fused multiply-add: fewer roundings, and the same results on every machine that has it.
@njit(nogil=True, cache=True, fastmath={"contract"})
def combine(
    code: NDArray[np.uint8],
    first: int,
    m: int,
    node: NDArray[np.int64],
    n: int,
    terms: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write the patterns' light on some nodes, -1 (black) to 1 (white), times their shares and summed.

    Parameters
    ----------
    code, first, m, node, n
        As in :func:`signed_codes`.
    terms : (1 or 6, n or more) float32
        As from :func:`sample`: shares of sum 1, and derivatives of sum 0.
    out : (1 or 6, m or more) float32
        Written.

    Notes
    -----
    With these sums, the light ``c 2 / 255 - 1`` of codes c gives the sum of ``terms c 2 / 255``, less 1 for the shares.
    To write the light of each node first took as long as its sums.
    """
    unit, whole = np.float32(2 / 255), n - n % 4
    for t in range(terms.shape[0]):
        for k in range(m):
            out[t, k] = -1.0 if t == 0 else 0.0
    # Four nodes at a time, so that sums are read and written a fourth as often. Unsigned indices can't count from the
    # end: signed ones take five times as long.
    for i in range(0, whole, 4):
        p, q, r, s = (
            np.uint64(node[i]),
            np.uint64(node[i + 1]),
            np.uint64(node[i + 2]),
            np.uint64(node[i + 3]),
        )
        for t in range(terms.shape[0]):
            a, b = unit * terms[t, i], unit * terms[t, i + 1]
            c, d = unit * terms[t, i + 2], unit * terms[t, i + 3]
            for k in range(m):
                at, to = np.uint64(first + k), np.uint64(k)
                both = a * np.float32(code[p, at]) + b * np.float32(code[q, at])
                out[t, to] += both + c * np.float32(code[r, at]) + d * np.float32(code[s, at])
    for i in range(whole, n):
        for t in range(terms.shape[0]):
            a = unit * terms[t, i]
            for k in range(m):
                out[t, np.uint64(k)] += a * np.float32(code[np.uint64(node[i]), np.uint64(first + k)])
