"""The fits of pixels: from the lobes of neighbours, or by a search; a second time where much is unexplained."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.fits import (
    ALL,
    DISPERSED,
    Fits,
    NodeBuffers,
    Pixels,
    fit_of,
    fits_of_transport,
    make_buffers,
    measurements_of,
    spread_to,
)
from workflows.recovery.lobes.fitting.levenberg_marquardt import fit_amounts, refine
from workflows.recovery.lobes.fitting.neighbours import MOST_REST, mean_square, start_between, unexplained
from workflows.recovery.lobes.fitting.search import fit
from workflows.recovery.lobes.footprint import PARAMETERS, PatternCodes
from workflows.recovery.lobes.likelihood import penalty
from workflows.recovery.lobes.mixture import Mixture, Workspace, clone, copy_mixture, make_workspace, move
from workflows.recovery.lobes.nodes import gather_lobes
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.lobes.posterior.evidence import log_evidence
from workflows.recovery.lobes.posterior.mean import update

# A fit that starts from neighbours ends when a step would lower chi-square by less than this for each parameter. Noise
# alone makes it 1.
_LEAST_STEP = 0.3
# In place of a fit to start from.
NONE = np.int64(-1)


@njit(nogil=True, cache=True, inline="always")
def keep_better(
    patterns: PatternCodes,
    mixture: Mixture,
    k: int,
    objective: float,
    tried: Mixture,
    new_k: int,
    new: float,
) -> tuple[int, float]:
    """Copy the lobes that were tried to `mixture` if they are better, their penalty counted; return what is kept."""
    before = objective + penalty(patterns.grids, mixture.level, k)
    if new + penalty(patterns.grids, tried.level, new_k) >= before:
        return k, objective
    copy_mixture(new_k, patterns.groups * len(patterns.strays), tried, mixture)
    return new_k, new


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
    workspace: Workspace,
) -> tuple[int, float]:
    """Fit the lobes of a pixel a second time, starting from the moments of the posterior mean.

    A lobe that is too wide and slightly rotated does not become narrow in small steps. Its posterior mean is narrow.

    Parameters
    ----------
    patterns, y, variance
        As in :func:`~workflows.recovery.lobes.fitting.levenberg_marquardt.refine`.
    mixture : Mixture
        Changed in place if the new fit is better.
    k : int
    objective : float
        -2 ln likelihood of the lobes.
    options : LobesOptions
    buffers : NodeBuffers
    workspace : Workspace

    Returns
    -------
    k : int
    objective : float
    """
    tried = clone(mixture)
    A = spread_to(buffers, patterns, tried, k, options.resolution, merged=False)
    # with a literal, numba would compile another version of `update`
    passes = np.int64(1)
    update(
        A,
        buffers.weight[: len(A)],
        buffers.end[:k],
        y,
        variance,
        patterns.strays,
        tried.stray,
        passes,
        options.gradients,
    )
    gather_lobes(patterns.grids, buffers.node, buffers.weight, buffers.end, tried, k, options.fit_resolution)
    new_k, _, new = fit(patterns, y, variance, tried, k, options, workspace)
    k, objective = keep_better(patterns, mixture, k, objective, tried, new_k, new)
    return k, objective


@njit(nogil=True, cache=True, inline="always")
def leading_channel(variance: NDArray[np.float32]) -> np.int64:
    """The channel with the highest total precision, from the variances (3, m + 2) of a pixel."""
    lead, highest = ALL, -1.0
    for c in range(3):
        precision = 0.0
        for j in range(variance.shape[1]):
            precision += 1 / variance[c, j]
        if precision > highest:
            lead, highest = np.int64(c), precision
    return lead


@njit(nogil=True, cache=True)
def start_fit(
    pixels: Pixels,
    p: int,
    c: int,
    neighbours: NDArray[np.int64],
    options: LobesOptions,
    fits: Fits,
    workspace: Workspace,
) -> bool:
    """Write fit c of a pixel, starting from those of its neighbours; return whether lobes must be searched again.

    So it is where the neighbours have none, and where the fit leaves more unexplained than theirs.
    """
    patterns, y, variance = measurements_of(pixels, p, c)
    mixture = fit_of(fits, p, c)
    k, rest = start_between(patterns, y, variance, fits, neighbours, c, mixture, options, workspace)
    fits.k[p, c], fits.objective[p, c] = k, np.inf
    if k == 0:
        return True
    least = _LEAST_STEP * (patterns.groups * len(patterns.strays) + PARAMETERS * k)
    _, objective, f, _ = refine(patterns, y, variance, mixture, k, options, workspace, least, np.inf)
    fits.objective[p, c], fits.rest[p, c] = objective, mean_square(patterns, y, variance, f)
    searched: bool = fits.rest[p, c] > MOST_REST * rest
    return searched


@njit(nogil=True, cache=True)
def search_fit(
    pixels: Pixels,
    p: int,
    c: int,
    source: int,
    options: LobesOptions,
    fits: Fits,
    buffers: NodeBuffers,
    workspace: Workspace,
) -> None:
    """Search the lobes of fit c of a pixel, starting from those of another fit or from none; keep the better fit."""
    patterns, y, variance = measurements_of(pixels, p, c)
    mixture = fit_of(fits, p, c)
    tried = clone(mixture)
    tried.stray[:], tried.dispersion[:] = 0, 0
    k = np.int64(0)
    if source != NONE:
        k = fits.k[p, source]
        copy_mixture(k, np.int64(0), fit_of(fits, p, source), tried)
        if source == DISPERSED:
            for i in range(k):
                move(tried.lobes[i], tried.dispersion, c)
            tried.dispersion[:] = 0
    k, kappa, objective = fit(patterns, y, variance, tried, k, options, workspace)
    if kappa > options.doubt and c != DISPERSED:
        k, objective = refit_from_posterior(
            patterns, y, variance, tried, k, objective, options, buffers, workspace
        )
    fits.k[p, c], fits.objective[p, c] = keep_better(
        patterns, mixture, fits.k[p, c], fits.objective[p, c], tried, k, objective
    )
    fits.rest[p, c] = unexplained(patterns, y, variance, mixture, fits.k[p, c], workspace)


@njit(nogil=True, cache=True)
def fit_pixel(
    pixels: Pixels,
    p: int,
    separate: bool,
    neighbours: NDArray[np.int64],
    options: LobesOptions,
    fits: Fits,
    buffers: NodeBuffers,
    workspace: Workspace,
) -> None:
    """Write the fits of a pixel that are needed.

    If `separate`, these are one fit for each channel, that of the most precise channel first. Otherwise they are the
    fit of all channels together, and under coloured patterns then also one for each channel.

    A fit starts from those of the neighbours. Where it leaves more unexplained than theirs, lobes are searched again,
    for all fits but the first starting from the first, and the better fit is kept. Under coloured patterns those of
    the channels are searched also from the fit whose lobes lie apart: a third of the measurements seldom suffices to
    find the place to which glass that disperses has moved the light.
    """
    own = pixels.own.variance[p]
    coloured = pixels.code.shape[1] > own.shape[1] - 2
    lead = leading_channel(own) if separate else ALL
    if start_fit(pixels, p, lead, neighbours, options, fits, workspace):
        search_fit(pixels, p, lead, NONE, options, fits, buffers, workspace)
    apart = False
    for c in range(3):
        if c == lead or np.isinf(own[c]).all() or (lead == ALL and not coloured):
            continue
        if start_fit(pixels, p, c, neighbours, options, fits, workspace):
            search_fit(pixels, p, c, lead, options, fits, buffers, workspace)
            if lead == ALL:
                if not apart and start_fit(pixels, p, DISPERSED, neighbours, options, fits, workspace):
                    search_fit(pixels, p, DISPERSED, NONE, options, fits, buffers, workspace)
                apart = True
                search_fit(pixels, p, c, DISPERSED, options, fits, buffers, workspace)


@njit(nogil=True, cache=True, inline="always")
def evidence(
    pixels: Pixels, p: int, c: int, fits: Fits, options: LobesOptions, buffers: NodeBuffers
) -> float:
    """-2 ln evidence for fit c of a pixel."""
    patterns, y, variance = measurements_of(pixels, p, c)
    fitted, k = fit_of(fits, p, c), fits.k[p, c]
    moved = clone(fitted)
    A = spread_to(buffers, patterns, moved, k, options.resolution, merged=True)
    found: float = log_evidence(A, buffers.weight[: len(A)], y, variance, patterns.strays, fitted.stray)
    return found


@njit(nogil=True, cache=True, inline="always")
def prefers_channels(
    pixels: Pixels,
    p: int,
    neighbours: NDArray[np.int64],
    separate: NDArray[np.bool_],
    options: LobesOptions,
    fits: Fits,
    buffers: NodeBuffers,
) -> bool:
    """Whether one T for each channel explains a pixel better than one T for all.

    Decided by the likelihood of the lobes, and where neighbours were decided otherwise, or there are none, by the
    evidence for T, which takes longer. There is a kappa for each T. Centres are ordinary parameters here, since the
    channels' lobes are near the common ones. Each costs what the Bayesian information criterion says with the evidence,
    and what Akaike's says, less, with lobes alone: what these cannot represent hides that channels differ.
    """
    more, agreed = 2 - PARAMETERS * fits.k[p, ALL], 0
    by_lobes = -fits.objective[p, ALL]
    for c in range(3):
        by_lobes += fits.objective[p, c]
        more += PARAMETERS * fits.k[p, c]
    better: bool = by_lobes + 2 * more < 0
    for q in neighbours:
        if q >= 0 and fits.k[q, ALL] > 0:
            agreed += 1 if separate[q] == better else -neighbours.size
    if agreed <= 0:
        by_evidence = -evidence(pixels, p, ALL, fits, options, buffers)
        for c in range(3):
            if fits.k[p, c] > 0:
                by_evidence += evidence(pixels, p, c, fits, options, buffers)
        better = by_evidence + math.log(pixels.joint.value.shape[1]) * more < 0
    return better


@njit(nogil=True, cache=True)
def fit_pixels(
    pixels: Pixels,
    alive: NDArray[np.bool_],
    order: NDArray[np.int64],
    neighbours: NDArray[np.int64],
    separate: NDArray[np.bool_],
    options: LobesOptions,
    fits: Fits,
) -> None:
    """Fit the lobes of n pixels.

    Parameters
    ----------
    pixels : Pixels
    alive : (n,) bool
        Pixels with a measurement; the others get no lobes.
    order, neighbours
        As from :func:`~workflows.recovery.lobes.fitting.neighbours.coarse_to_fine`.
    separate : (n,) bool
        Whether each channel gets its own T. Under coloured patterns this is decided here and written.
    options : LobesOptions
    fits : Fits
        Written.
    """
    size = pixels.joint.value.shape[1]
    groups = size // pixels.own.value.shape[2]
    buffers, workspace = make_buffers(options.most_lobes, size, len(pixels.code)), make_workspace(size)
    for p in order:
        if alive[p]:
            fit_pixel(pixels, p, separate[p], neighbours[p], options, fits, buffers, workspace)
            if groups == 3:
                separate[p] = prefers_channels(pixels, p, neighbours[p], separate, options, fits, buffers)
    for p in range(alive.size if len(pixels.strays) > 1 else 0):
        for c in fits_of_transport(separate[p]):
            if fits.k[p, c] > 0:
                patterns, y, variance = measurements_of(pixels, p, c)
                fit_amounts(patterns, y, variance, fit_of(fits, p, c), fits.k[p, c], workspace)
