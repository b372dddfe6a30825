"""Whether the channels of a pixel have one T or one each, where the pixels about it do not agree.

One T for three channels is known from three times as many measurements, and wrong where glass disperses. The evidence
for either is weighed once the fits are averages, which follow the noise less, with the shares about the pixel as the
prior: how much glass disperses changes little from pixel to pixel.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.fits import ALL, Fits, Pixels, make_buffers
from workflows.recovery.lobes.fitting.pixels import evidence
from workflows.recovery.lobes.footprint import PARAMETERS
from workflows.recovery.lobes.options import LobesOptions

# The evidence is raised to one over this, as the likelihood is in averages of fits.
_TEMPERATURE = 8.0
# How many pixels about one the mean of all counts for.
_OF_ALL = 4.0
_ROUNDS = 10
# Shares are at least this far from 0 and 1 where they are a prior, and are rounded to these in the result.
_LEAST_PRIOR, _LEAST_SHARE = 0.01, 0.05


def disputed(separate: NDArray[np.bool_], near: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of n pixels have others about them, (n, 8) as from `adjacent`, that were decided otherwise, (n,) bool."""
    differ: NDArray[np.bool_] = ((separate[near] != separate[:, np.newaxis]) & (near >= 0)).any(axis=1)
    return differ


@njit(nogil=True, cache=True)
def share_of_separate(
    pixels: Pixels,
    near: NDArray[np.int64],
    separate: NDArray[np.bool_],
    open_to_both: NDArray[np.bool_],
    fits: Fits,
    averages: Fits,
    options: LobesOptions,
) -> NDArray[np.float64]:
    """How much of the T of each of n pixels is that of its own channel, and not the common one.

    Parameters
    ----------
    pixels : Pixels
    near : (n, 8) int64
        As from :func:`~workflows.recovery.lobes.fitting.averages.adjacent`.
    separate : (n,) bool
        What the others have.
    open_to_both : (n,) bool
        Pixels that may have some of both.
    fits, averages : Fits
        Of all channels together and of each, before and after they were averaged.
    options : LobesOptions

    Returns
    -------
    (n,) float64
        From 0 to 1.

    Notes
    -----
    Each share is the posterior probability ``1 / (1 + exp(d / 2 t) (1 - q) / q)``, d the difference of -2 ln evidence
    plus the number of additional parameters, t the temperature, and q the mean share about the pixel. The shares follow
    from one another in a few rounds, as in a mean field.
    """
    n, worse = separate.size, np.zeros(separate.size)
    buffers = make_buffers(averages.level.shape[2], pixels.joint.value.shape[1], len(pixels.code))
    for p in range(n):
        if open_to_both[p]:
            worse[p] = 2 - PARAMETERS * fits.k[p, ALL] - evidence(pixels, p, ALL, averages, options, buffers)
            for c in range(3):
                if fits.k[p, c] > 0:
                    worse[p] += PARAMETERS * fits.k[p, c] + evidence(pixels, p, c, averages, options, buffers)
    share, prior = separate.astype(np.float64), np.full(n, 0.5)
    for _ in range(_ROUNDS):
        for p in range(n):
            if open_to_both[p]:
                odds = math.log(prior[p] / (1 - prior[p])) - worse[p] / (2 * _TEMPERATURE)
                share[p] = 1 / (1 + math.exp(min(max(-odds, -50.0), 50.0)))
        mean = share.mean()
        for p in range(n):
            total, count = _OF_ALL * mean, _OF_ALL
            for q in near[p]:
                if q >= 0:
                    total += share[q]
                    count += 1
            prior[p] = min(max(total / count, _LEAST_PRIOR), 1 - _LEAST_PRIOR)
    for p in range(n):
        if share[p] < _LEAST_SHARE:
            share[p] = 0.0
        elif share[p] > 1 - _LEAST_SHARE:
            share[p] = 1.0
    return share
