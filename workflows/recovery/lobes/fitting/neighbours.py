"""Fits that start from those of neighbours, which see much the same: the more so, the larger the frame.

Pixels are fitted from coarse to fine: every eighth of every eighth row first, then those half way between these, and
so on. So all but the first lie between pixels that are fitted. The mean of their lobes is a start that seldom needs a
step, and often leaves no more unexplained than a search would.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.fits import Fits, fit_of
from workflows.recovery.lobes.footprint import PatternCodes, fit_level
from workflows.recovery.lobes.mixture import (
    Mixture,
    Workspace,
    clone,
    copy_mixture,
    predict,
    without_derivatives,
)
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.pyramid import bump_variance

MOST_REST = 1.7
"""Lobes are searched again where the squared residual is this many times that of the neighbours. Of 128 measurements,
noise alone makes it 1.4 in one pixel of a hundred."""

# Distance of the pixels that are fitted first, a power of two.
_STRIDE = 8
# Neighbours are no start where they leave more than this share of the patterns unexplained.
_MOST_UNLIKE = 0.3


def coarse_to_fine(
    places: NDArray[np.integer] | None, pixels: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Order pixels from coarse to fine, and find the neighbours of each that come before it.

    Parameters
    ----------
    places : (n, 2) int or None
        Rows and columns of the pixels in their frame, zero or more. None if none is another's neighbour.
    pixels : int
        n.

    Returns
    -------
    order : (n,) int64
        The pixels' numbers.
    neighbours : (n, 4) int64
        Numbers of those half way to which a pixel lies; -1 for none.

    Examples
    --------
    >>> order, neighbours = coarse_to_fine(np.array([[0, 6], [0, 7], [0, 8]]), 3)
    >>> order.tolist(), neighbours.tolist()
    ([2, 0, 1], [[-1, 2, -1, -1], [0, 2, -1, -1], [-1, -1, -1, -1]])
    """
    neighbours = np.full((pixels, 4), -1)
    if places is None or not pixels:
        return np.arange(pixels), neighbours
    row, column = places.T
    # with a margin, so that those outside are looked up too
    r, c = (places - places.min(axis=0) + _STRIDE).T
    number = np.full((r.max() + _STRIDE + 1, c.max() + _STRIDE + 1), -1)
    number[r, c] = np.arange(pixels)
    order = [np.flatnonzero((row % _STRIDE == 0) & (column % _STRIDE == 0))]
    step = _STRIDE
    while step > 1:
        step //= 2
        between_rows, between_columns = row % (2 * step) == step, column % (2 * step) == step
        on_row, on_column = row % (2 * step) == 0, column % (2 * step) == 0
        diagonal, straight = ((-1, -1), (-1, 1), (1, -1), (1, 1)), ((0, -1), (0, 1), (-1, 0), (1, 0))
        for which, directions in (
            (between_rows & between_columns, diagonal),
            ((on_row & between_columns) | (between_rows & on_column), straight),
        ):
            found = np.flatnonzero(which)
            order.append(found)
            for i, (down, right) in enumerate(directions):
                neighbours[found, i] = number[r[found] + step * down, c[found] + step * right]
    return np.concatenate(order), neighbours


@njit(nogil=True, cache=True)
def mean_square(
    patterns: PatternCodes, y: NDArray[np.float32], variance: NDArray[np.float32], f: NDArray[np.float32]
) -> float:
    """Mean squared difference of the measurements of patterns, (groups (m + 2),), and a prediction."""
    size, square, used = patterns.m + 2, 0.0, 0
    for g in range(patterns.groups):
        for j in range(g * size, g * size + patterns.m):
            if variance[j] < np.inf:
                square += float(y[j] - f[j]) ** 2
                used += 1
    mean: float = square / max(used, 1)
    return mean


@njit(nogil=True, cache=True)
def unexplained(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    workspace: Workspace,
) -> float:
    """Mean squared difference of the measurements of patterns and what k lobes predict."""
    f, response = np.empty_like(y), np.empty((k, 1, y.size), np.float32)
    predict(patterns, mixture, k, without_derivatives(workspace), response, f)
    rest: float = mean_square(patterns, y, variance, f)
    return rest


@njit(nogil=True, cache=True)
def _average(
    patterns: PatternCodes,
    fits: Fits,
    neighbours: NDArray[np.int64],
    n: int,
    c: int,
    mixture: Mixture,
    resolution: float,
) -> int:
    """Write the mean of the fits c of n neighbours; return its number of lobes, 0 if theirs differ.

    Centres and weights are averaged, and covariances: half way between two lobes of one shape lies a lobe of that
    shape.
    """
    first = neighbours[0]
    k, strays = fits.k[first, c], patterns.groups * len(patterns.strays)
    for e in range(1, n):
        if fits.k[neighbours[e], c] != k:
            return 0
    for s in range(strays):
        mixture.stray[s] = 0
        for e in range(n):
            mixture.stray[s] += fits.stray[neighbours[e], c, s] / n
    mixture.dispersion[:] = 0
    for e in range(n):
        mixture.dispersion[:] += fits.dispersion[neighbours[e], c] / n
    for i in range(k):
        mean, xx, xy, yy = mixture.lobes[i], 0.0, 0.0, 0.0
        mean[:3] = 0
        for e in range(n):
            lobe = fits.lobes[neighbours[e], c, i]
            blur = bump_variance(fits.level[neighbours[e], c, i])
            for t in range(3):
                mean[t] += lobe[t] / n
            xx += (lobe[3] ** 2 + blur) / n
            xy += lobe[3] * lobe[4] / n
            yy += (lobe[4] ** 2 + lobe[5] ** 2 + blur) / n
        level = fits.level[first, c, i]
        blur = bump_variance(level)
        mean[3] = math.sqrt(max(xx - blur, 1e-3))
        mean[4] = xy / mean[3]
        mean[5] = math.sqrt(max(yy - blur - mean[4] ** 2, 1e-3))
        mixture.level[i] = fit_level(mean, level, patterns.grids.columns, resolution)
    return int(k)


@njit(nogil=True, cache=True)
def start_between(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    fits: Fits,
    neighbours: NDArray[np.int64],
    c: int,
    mixture: Mixture,
    options: LobesOptions,
    workspace: Workspace,
) -> tuple[int, float]:
    """Start a fit from the same fits of a pixel's neighbours: from their mean, or the one that explains most.

    An edge between two lobes stays an edge: on it the mean explains little, and one of the neighbours more.

    Parameters
    ----------
    patterns : PatternCodes
    y, variance : (groups (m + 2),) float32
        As in :func:`~workflows.recovery.lobes.fitting.levenberg_marquardt.refine`.
    fits : Fits
    neighbours : (4,) int64
        Of the pixel, as from :func:`coarse_to_fine`.
    c : int
        Which of the fits.
    mixture : Mixture
        Written.
    options : LobesOptions
        `fit_resolution` is used.
    workspace : Workspace

    Returns
    -------
    k : int
        Number of lobes; 0 if the neighbours have none or explain too little.
    rest : float
        Mean squared residual of the neighbours.
    """
    near, n = np.empty(neighbours.size, np.int64), np.int64(0)
    for q in neighbours:
        if q >= 0 and fits.k[q, c] > 0:
            near[n] = q
            n += 1
    if n == 0:
        return 0, 0.0
    rest = 0.0
    for e in range(n):
        rest += fits.rest[near[e], c] / n
    k = _average(patterns, fits, near, n, c, mixture, options.fit_resolution)
    least = unexplained(patterns, y, variance, mixture, k, workspace) if k > 0 else np.inf
    if least > MOST_REST * rest:
        strays = patterns.groups * len(patterns.strays)
        tried = clone(mixture)
        for e in range(n):
            of_one = fits.k[near[e], c]
            copy_mixture(of_one, strays, fit_of(fits, near[e], c), tried)
            left = unexplained(patterns, y, variance, tried, of_one, workspace)
            if left < least:
                least, k, rest = left, of_one, fits.rest[near[e], c]
                copy_mixture(k, strays, tried, mixture)
        if least > _MOST_UNLIKE * mean_square(patterns, y, variance, np.zeros_like(y)):
            return 0, 0.0
    return k, rest
