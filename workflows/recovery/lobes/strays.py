"""Light that changes from frame to frame but does not come from the patterns, as of the border of a film."""

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import betaincinv

from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry, solve_least_squares

STRAY = 0.1
"""Prior standard deviation of an amount of stray light that is not constant, in units of T."""
STRONG = 0.17
"""Stray light that explains this share of the variance of a pixel is taken out before recovery,"""
SURE = 0.993
"""if in this share of the pixels chance explains less."""


def find_strong_strays(
    light: PatternLight, photometry: Photometry, strays: NDArray[np.float32]
) -> tuple[NDArray[np.float32], Photometry]:
    """Find the stray light of pixels that see more of it than of the patterns, as those that see a film's border.

    Parameters
    ----------
    light : PatternLight
    photometry : Photometry
        From constant monitors.
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.normalise.Conditions`; the first is constant.

    Returns
    -------
    stray : (n, m, 3) float32
        In camera units; 0 at other pixels.
    photometry : Photometry
        Of what is left: of many such pixels, S alone.

    Notes
    -----
    ``C = S + rho / 2 + sum_s a_s B_s`` is fitted to the patterns, and ``S + sum a_s B_s`` and ``S + rho + sum a_s B_s``
    to black and white, whose weight is the inverse of their variances. What patterns show besides is like noise here,
    of the variance that is left.
    """
    seen, usable, worth = (array.transpose(0, 2, 1) for array in light)
    m = seen.shape[2]
    constants = np.stack([photometry.S, photometry.S + photometry.rho], axis=2)
    values = np.concatenate([seen, constants], axis=2).astype(np.float64)
    known = np.isfinite(values)
    known[:, :, :m] &= usable
    values = np.where(known, values, 0)
    half = np.concatenate([np.full(m, 0.5), [0, 1]])
    design = np.concatenate([strays[:1], half[np.newaxis], strays[1:]]).T.astype(np.float64)
    weight = known.astype(np.float64)
    weight[:, :, m:] = 0
    # Of values that are bounds little is known: they must not look like the border's light.
    weight[:, :, :m] *= worth / worth.max(axis=2, keepdims=True)
    count = np.maximum(weight.sum(axis=2, keepdims=True), 1)
    before = (weight * (values - (weight * values).sum(axis=2, keepdims=True) / count) ** 2).sum(axis=2)
    alone = np.delete(design, 1, axis=1)
    amount, inverse = solve_least_squares(alone, weight, values)
    after = (weight * (values - amount @ alone.T) ** 2).sum(axis=2)
    # The rank as a trace: to decompose the matrices once more takes five times as long.
    gram = np.einsum("kp,nck,kq->ncpq", alone, weight, alone, optimize=True)
    rows = np.rint(np.einsum("ncpq,ncqp->nc", inverse, gram)) - 1
    strong = before - after > np.maximum(STRONG, _share_by_chance(rows, count[..., 0])) * before
    # From here on strong values alone, few of n times 3.
    values, weight = values[strong], weight[strong]
    weight /= np.maximum(after / count[..., 0], 1e-12)[strong, np.newaxis]
    weight[:, m:] = 1 / np.stack(
        [photometry.black_variance[strong], photometry.white_variance[strong]], axis=1
    )
    found, covariance = solve_least_squares(design, weight, values)
    stray = np.zeros(seen.shape, np.float32)
    stray[strong] = found[:, 2:] @ design[:m, 2:].T
    S, rho = found[:, 0], found[:, 1]
    white = np.array([1.0, 1.0])
    fitted = (
        np.where(rho > 0, S, S + rho / 2),
        np.maximum(rho, 0),
        covariance[:, 0, 0],
        np.einsum("i,nij,j->n", white, covariance[:, :2, :2], white),
    )
    better = Photometry(*(old.astype(np.float32) for old in photometry))
    for of_all, of_strong in zip(better, fitted, strict=True):
        of_all[strong] = of_strong
    return stray.transpose(0, 2, 1), better


def _share_by_chance(rows: NDArray[np.float64], count: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share of the variance of values that stray light explains by chance of `SURE` of the pixels, or less.

    Of k values, p independent rows of light explain a share that is distributed as Beta(p / 2, (k - p - 1) / 2) (Seber
    and Lee, Linear Regression Analysis, 2003, ch. 4). Of fewer than 2 p + 2 they explain black and white ones exactly
    too often.
    """
    free = count - rows - 1
    share = betaincinv(np.maximum(rows, 1) / 2, np.maximum(free, 1) / 2, SURE)
    return np.where((free > rows) & (rows > 0), share, 1)


@njit(nogil=True, cache=True)
def write_strays(
    strays: NDArray[np.float32], amount: NDArray[np.float64], first: int, f: NDArray[np.float32]
) -> None:
    """Write stray light from the given row of `strays` on, in the given amounts.

    Parameters
    ----------
    strays : (s, m + 2) float32
    amount : (groups s or more,) float64
    first : int
    f : (groups (m + 2),) float32
        Written.
    """
    count, size = strays.shape
    for g in range(f.size // size):
        of_group = f[g * size : (g + 1) * size]
        of_group[:] = 0
        for s in range(first, count):
            share = np.float32(amount[g * count + s])
            for j in range(size):
                of_group[j] += share * strays[s, j]


# With types, since it is called by a kernel and by itself: see `workflows.recovery.solvers`.
@njit("void(float32[::1], float32[::1], float32[::1], int64)", nogil=True, cache=True)
def subtract_strays(
    y: NDArray[np.float32], variance: NDArray[np.float32], stray: NDArray[np.float32], size: int
) -> None:
    """Subtract stray light from measurements, and normalise what is left so that black is -1 and white 1 again.

    Parameters
    ----------
    y, variance : (groups size,) float32
        Changed in place. The last two values of each group are those of a black and a white monitor.
    stray : (groups size,) float32
    size : int
        Measurements of a group.
    """
    for first in range(0, y.size, size):
        black = y[first + size - 2] - stray[first + size - 2]
        white = y[first + size - 1] - stray[first + size - 1]
        scale = np.float32(2) / max(white - black, np.float32(0.1))
        for j in range(first, first + size):
            y[j] = (y[j] - stray[j] - black) * scale - 1
            variance[j] *= scale**2
