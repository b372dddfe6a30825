"""Averages of the fits of a pixel and of those about it, moved to its place: where the posterior mean of T starts.

Several sets of lobes explain the measurements of a pixel about as well, the more so the fewer patterns there are, and
the best of them has fitted their noise too. Bayesian model averaging (Hoeting et al., Statistical Science, 1999) takes
the mean of T over all of them, each with its share of the likelihood. The fits of the pixels about it, of its other
channels, and of all channels with their lobes apart, are such sets, found from other measurements.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.fits import (
    ALL,
    DISPERSED,
    Fits,
    Pixels,
    fit_of,
    fits_of_transport,
    measurements_of,
)
from workflows.recovery.lobes.footprint import PARAMETERS
from workflows.recovery.lobes.likelihood import penalty, weigh
from workflows.recovery.lobes.mixture import (
    Mixture,
    Workspace,
    copy_mixture,
    make_workspace,
    move,
    predict,
    without_derivatives,
)

KEPT = 8
"""Fits that are averaged, at most: the likeliest."""

# Of this many measurements, half as many fits: the others gain little there, and take time.
_MANY = 100
# Rows and columns from a pixel to the eight about it.
_OFFSETS = np.array([(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right])
# Another fit may leave -2 ln likelihood higher by this for each parameter: its own noise is not fitted.
_ALLOWED = 5.0
# The likelihood is raised to one over this, since errors of the model are not independent as those of noise are.
_TEMPERATURE = 30.0
# Least share of a fit in an average.
_LEAST_SHARE = 0.02


def adjacent(places: NDArray[np.integer]) -> NDArray[np.int64]:
    """The numbers of the pixels about each pixel.

    Parameters
    ----------
    places : (n, 2) int
        Rows and columns of the pixels in their frame.

    Returns
    -------
    (n, 8) int64
        Row by row; -1 for none.

    Examples
    --------
    >>> adjacent(np.array([[0, 6], [0, 7], [1, 6]])).tolist()[0]
    [-1, -1, -1, -1, 1, -1, 2, -1]
    """
    if not len(places):
        return np.empty((0, len(_OFFSETS)), np.int64)
    width = places[:, 1].max() + 3
    key = (places[:, 0] + 1) * width + places[:, 1] + 1
    order = np.argsort(key)
    wanted = key[:, np.newaxis] + _OFFSETS @ [width, 1]
    at = order[np.minimum(np.searchsorted(key, wanted, sorter=order), len(places) - 1)]
    return np.where(key[at] == wanted, at, -1)


@njit(nogil=True, cache=True)
def _centre(lobes: NDArray[np.float64], k: NDArray[np.int64], p: int, c: int) -> tuple[float, float]:
    """The centre x, y of the heaviest lobe of fit c of a pixel, from `lobes` and `k` of `Fits`."""
    heaviest = 0
    for i in range(1, k[p, c]):
        if lobes[p, c, i, 0] > lobes[p, c, heaviest, 0]:
            heaviest = i
    return lobes[p, c, heaviest, 1], lobes[p, c, heaviest, 2]


@njit(nogil=True, cache=True)
def _median(moved: NDArray[np.float64]) -> tuple[float, float]:
    """The medians of x and y, (2, n), 0 if there are none: some of the pixels may have another heaviest lobe."""
    x, y = 0.0, 0.0
    if moved.shape[1] > 0:
        x, y = float(np.median(moved[0])), float(np.median(moved[1]))
    return x, y


@njit(nogil=True, cache=True)
def _slope(fits: Fits, p: int, c: int, near: NDArray[np.int64], axis: int) -> tuple[float, float]:
    """How far the heaviest lobe moves to the next pixel along rows (0) or columns (1), x and y."""
    centre, lobes, k = np.full((2, 3, 3), np.nan), fits.lobes, fits.k
    for e in range(-1, near.size):
        q = p if e < 0 else near[e]
        if q >= 0 and k[q, c] > 0:
            down, right = (0, 0) if e < 0 else (_OFFSETS[e, 0], _OFFSETS[e, 1])
            along, across = (1 + down, 1 + right) if axis == 0 else (1 + right, 1 + down)
            centre[0, along, across], centre[1, along, across] = _centre(lobes, k, q, c)
    moved, n = np.empty((2, 6)), 0
    for i in range(3):
        for j in range(2):
            x, y = centre[0, j + 1, i] - centre[0, j, i], centre[1, j + 1, i] - centre[1, j, i]
            if not math.isnan(x):
                moved[0, n], moved[1, n] = x, y
                n += 1
    x, y = _median(moved[:, :n])
    return x, y


@njit(nogil=True, cache=True)
def _dispersion(fits: Fits, p: int, c: int, other: int, near: NDArray[np.int64]) -> tuple[float, float]:
    """How far the heaviest lobe of channel c lies from that of another channel, x and y."""
    moved, n, lobes, k = np.empty((2, near.size + 1)), 0, fits.lobes, fits.k
    for e in range(-1, near.size):
        q = p if e < 0 else near[e]
        if q >= 0 and k[q, c] > 0 and k[q, other] > 0:
            (x, y), (other_x, other_y) = _centre(lobes, k, q, c), _centre(lobes, k, q, other)
            moved[0, n], moved[1, n] = x - other_x, y - other_y
            n += 1
    x, y = _median(moved[:, :n])
    return x, y


@njit(nogil=True, cache=True)
def _other_fit(e: int, c: int, about: int) -> tuple[int, int]:
    """Another fit that may explain fit c of a pixel: which of the pixels about it, 0 for itself, and of which channels.

    First come the ``about`` ones of c, then those of the other channels and of all, then those with lobes apart.
    """
    if e < about:
        return e, c
    if e < about + 2:
        return 0, (c + 1 + e - about) % 3
    if e == about + 2:
        return 0, int(ALL)
    return e - about - 3, int(DISPERSED)


@njit(nogil=True, cache=True)
def _average(
    pixels: Pixels,
    p: int,
    c: int,
    near: NDArray[np.int64],
    fits: Fits,
    averages: Fits,
    workspace: Workspace,
) -> None:
    """Write the average for fit c of a pixel."""
    patterns, y, variance = measurements_of(pixels, p, c)
    (x_down, y_down), (x_right, y_right) = _slope(fits, p, c, near, 0), _slope(fits, p, c, near, 1)
    about = near.size + 1  # with the pixel itself
    most, n = fits.level.shape[2], about if c == ALL else 2 * about + 3
    count, objective = np.zeros(n, np.int64), np.full(n, np.inf)
    lobes, level = np.empty((n, most, PARAMETERS)), np.empty((n, most), np.int64)
    f, precision = np.empty_like(y), np.empty_like(y)
    response, together = np.empty((most, 1, y.size), np.float32), np.zeros(2)
    for e in range(n):
        i, d = _other_fit(e, c, about)
        q = near[i - 1] if i > 0 else p
        if q < 0 or fits.k[q, d] == 0:
            continue
        k = fits.k[q, d]
        tried = Mixture(lobes[e], level[e], fits.stray[p, c], together)
        copy_mixture(k, np.int64(0), fit_of(fits, q, d), tried)
        across, along = 0.0, 0.0
        if i > 0:
            down, right = _OFFSETS[i - 1]
            across, along = -down * x_down - right * x_right, -down * y_down - right * y_right
        elif d != c and d != DISPERSED:
            across, along = _dispersion(fits, p, c, d, near)
        if d == DISPERSED:
            for j in range(k):
                move(lobes[e, j], tried.dispersion, c)
            tried.dispersion[:] = 0
        lobes[e, :k, 1] += across
        lobes[e, :k, 2] += along
        predict(patterns, tried, k, without_derivatives(workspace), response, f)
        _, explained = weigh(y, f, variance, patterns.groups, PARAMETERS * k, precision)
        # Fits of the same measurements have fitted their noise, those of all channels too.
        has_others = i > 0 or (d != c and d < ALL)
        allowed = _ALLOWED * PARAMETERS * k if has_others else 0.0
        count[e], objective[e] = k, explained + penalty(patterns.grids, tried.level, k) - allowed
    best = np.argsort(objective)[: KEPT if y.size < _MANY else KEPT // 2]
    share = np.exp((objective[best[0]] - objective[best]) / (2 * _TEMPERATURE))
    share[share < _LEAST_SHARE * share.sum()] = 0
    share /= share.sum()
    written, end = fit_of(averages, p, c), 0
    for i in range(best.size):
        if share[i] > 0:
            for j in range(count[best[i]]):
                written.lobes[end] = lobes[best[i], j]
                written.lobes[end, 0] *= share[i]
                written.level[end] = level[best[i], j]
                end += 1
    written.stray[:] = fits.stray[p, c]
    averages.k[p, c] = end


@njit(nogil=True, cache=True)
def average_fits(
    pixels: Pixels,
    near: NDArray[np.int64],
    separate: NDArray[np.bool_],
    open_to_both: NDArray[np.bool_],
    fits: Fits,
    averages: Fits,
) -> None:
    """Average the fits of n pixels that T is made of with those of the pixels about them, and of their other channels.

    Parameters
    ----------
    pixels : Pixels
    near : (n, 8) int64
        As from :func:`adjacent`.
    separate : (n,) bool
        Whether each channel has its own T.
    open_to_both : (n,) bool
        Pixels whose fits are averaged for one T of all channels and for one of each.
    fits : Fits
    averages : Fits
        With room for `KEPT` times as many lobes. Lobes, levels, stray light and numbers of lobes are written.
    """
    workspace = make_workspace(pixels.joint.value.shape[1])
    for p in range(separate.size):
        for c in range(ALL + 1) if open_to_both[p] else fits_of_transport(separate[p]):
            if fits.k[p, c] > 0:
                _average(pixels, p, c, near[p], fits, averages, workspace)
