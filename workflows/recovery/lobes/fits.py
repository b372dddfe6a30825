"""The fits of lobes to a pixel: one to all channels, or one to each; a second time where much is unexplained."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import PARAMETERS, PatternCodes
from workflows.recovery.lobes.likelihood import penalty
from workflows.recovery.lobes.mixture import Mixture, copy_mixture
from workflows.recovery.lobes.nodes import gather_lobes, node_responses, spread_lobes
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.lobes.posterior.mean import update
from workflows.recovery.lobes.search import fit
from workflows.recovery.normalise import Measurements
from workflows.recovery.pyramid import Grids

ALL = 3
"""A pixel has four fits: 0 to 2 are those of its channels, and this is the one of all channels together."""


class Pixels(NamedTuple):
    """The measurements of n pixels, and their patterns.

    Attributes
    ----------
    grids : Grids
    code : (nodes, channels m) uint8
        Light of the m patterns on the nodes of the pyramid; 1 or 3 channels.
    joint : Measurements
        Measurements of all channels together, (n, channels (m + 2)).
    own : Measurements
        Measurements of each channel, (n, 3, m + 2).
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.lobes.footprint.PatternCodes`.
    """

    grids: Grids
    code: NDArray[np.uint8]
    joint: Measurements
    own: Measurements
    strays: NDArray[np.float32]


class Fits(NamedTuple):
    """The four fits of a pixel.

    Attributes
    ----------
    lobes : (4, most, 6) float64
    level : (4, most) int64
    stray : (4, 3 s) float64
        As in :class:`~workflows.recovery.lobes.mixture.Mixture`.
    k : (4,) int64
        Number of lobes of each fit; 0 where there is no fit.
    objective : (4,) float64
        -2 ln likelihood.
    """

    lobes: NDArray[np.float64]
    level: NDArray[np.int64]
    stray: NDArray[np.float64]
    k: NDArray[np.int64]
    objective: NDArray[np.float64]


class NodeBuffers(NamedTuple):
    """Working space for the nodes under all lobes of a fit.

    Attributes
    ----------
    node : (most NODES,) int64
    weight : (most NODES,) float32
    end : (most,) int64
        As from :func:`~workflows.recovery.lobes.nodes.spread_lobes`.
    rows : (most NODES channels (m + 2),) float32
    """

    node: NDArray[np.int64]
    weight: NDArray[np.float32]
    end: NDArray[np.int64]
    rows: NDArray[np.float32]


@njit(nogil=True, cache=True, inline="always")
def refit_from_posterior(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    objective: float,
    options: LobesOptions,
    buffers: NodeBuffers,
) -> tuple[int, float]:
    """Fit the lobes of a pixel a second time, starting from the moments of the posterior mean.

    A lobe that is too wide and slightly rotated does not become narrow in small steps. Its posterior mean is narrow.

    Parameters
    ----------
    patterns, y, variance
        As in :func:`~workflows.recovery.lobes.levenberg_marquardt.refine`.
    mixture : Mixture
        Changed in place if the new fit is better.
    k : int
    objective : float
        -2 ln likelihood of the lobes.
    options : LobesOptions
    buffers : NodeBuffers

    Returns
    -------
    k : int
    objective : float
    """
    tried = Mixture(mixture.lobes.copy(), mixture.level.copy(), mixture.stray.copy())
    n = spread_lobes(patterns.grids, tried, k, options.resolution, buffers.node, buffers.weight, buffers.end)
    A = buffers.rows[: n * y.size].reshape(n, y.size)
    node_responses(patterns, buffers.node, n, A)
    # with a literal, numba would compile another version of `update`
    passes = np.int64(1)
    update(
        A,
        buffers.weight[:n],
        buffers.end[:k],
        y,
        variance,
        patterns.strays,
        tried.stray,
        passes,
        options.gradients,
    )
    gather_lobes(patterns.grids, buffers.node, buffers.weight, buffers.end, tried, k, options.fit_resolution)
    new_k, _, new = fit(patterns, y, variance, tried, k, options)
    if new + penalty(patterns.grids, tried.level, new_k) >= objective + penalty(
        patterns.grids, mixture.level, k
    ):
        return k, objective
    copy_mixture(new_k, patterns.groups * len(patterns.strays), tried, mixture)
    return new_k, new


@njit(nogil=True, cache=True)
def measurements_of(
    pixels: Pixels, p: int, c: int
) -> tuple[PatternCodes, NDArray[np.float32], NDArray[np.float32]]:
    """The patterns, measurements and variances for fit c of pixel p."""
    grids, code, joint, own, _ = pixels
    m = own.value.shape[2] - 2
    groups = code.shape[1] // m
    if c == ALL:
        return PatternCodes(grids, code, 0, groups, m, pixels.strays), joint.value[p], joint.variance[p]
    first = c * m if groups == 3 else 0
    return PatternCodes(grids, code, first, 1, m, pixels.strays), own.value[p, c], own.variance[p, c]


@njit(nogil=True, cache=True, inline="always")
def leading_channel(variance: NDArray[np.float32]) -> int:
    """The channel with the highest total precision, from the variances (3, m + 2) of a pixel."""
    lead, highest = ALL, -1.0
    for c in range(3):
        precision = 0.0
        for j in range(variance.shape[1]):
            precision += 1 / variance[c, j]
        if precision > highest:
            lead, highest = c, precision
    return lead


@njit(nogil=True, cache=True, inline="always")
def fit_pixel(
    pixels: Pixels, p: int, separate: bool, options: LobesOptions, fits: Fits, buffers: NodeBuffers
) -> None:
    """Write the fits of a pixel that are needed.

    If `separate`, these are one fit for each channel, that of the most precise channel first. Otherwise they are the
    fit of all channels together, and under coloured patterns then also one for each channel. All others start from the
    lobes of the first.
    """
    own = pixels.own.variance[p]
    groups = pixels.code.shape[1] // (own.shape[1] - 2)
    fits.stray[:] = 0
    fits.k[:], fits.objective[:] = 0, 0
    lead = leading_channel(own) if separate else ALL
    for turn in range(-1, 3):
        c = lead if turn < 0 else turn
        if turn == lead or (c < ALL and (np.isinf(own[c]).all() or (lead == ALL and groups == 1))):
            continue
        mixture = Mixture(fits.lobes[c], fits.level[c], fits.stray[c])
        if turn >= 0:
            fits.k[c] = fits.k[lead]
            first = Mixture(fits.lobes[lead], fits.level[lead], fits.stray[lead])
            copy_mixture(fits.k[lead], np.int64(0), first, mixture)
        patterns, y, variance = measurements_of(pixels, p, c)
        k, kappa, objective = fit(patterns, y, variance, mixture, fits.k[c], options)
        if kappa > options.doubt:
            k, objective = refit_from_posterior(
                patterns, y, variance, mixture, k, objective, options, buffers
            )
        fits.k[c], fits.objective[c] = k, objective


@njit(nogil=True, cache=True, inline="always")
def prefers_channels(fits: Fits, size: int) -> bool:
    """Whether one T for each channel explains a pixel better than one T for all, given `size` measurements.

    Decided by the Bayesian information criterion, with a kappa for each T. Centres are ordinary parameters here, since
    the channels' lobes are near the common ones.
    """
    log_size = math.log(size)
    joint = fits.objective[ALL] + log_size * (PARAMETERS * fits.k[ALL] + 1)
    separate = 0.0
    for c in range(3):
        separate += fits.objective[c] + log_size * (PARAMETERS * fits.k[c] + 1)
    better: bool = separate < joint
    return better
