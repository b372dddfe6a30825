"""The recovery of pixels one by one: lobes, fitted again where they miss, and the posterior mean about them."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import NODES, PARAMETERS, Shown
from workflows.recovery.lobes.likelihood import price
from workflows.recovery.lobes.mixture import Mixture, copy_mixture
from workflows.recovery.lobes.nodes import gather_lobes, rows_of, spread_lobes
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.lobes.posterior import update
from workflows.recovery.lobes.search import fit
from workflows.recovery.normalise import Measurements
from workflows.recovery.pyramid import Grids
from workflows.recovery.solvers import subtract

# Nodes that the rows of a block have room for at first.
_ROOM = 1 << 16
# A pixel has four fits: 0 to 2 are those of its channels, and this is that of all channels together.
_ALL = 3


class Pixels(NamedTuple):
    """The measurements of n pixels, and the patterns that they saw.

    Attributes
    ----------
    grids : Grids
    code : (nodes, channels m) uint8
        Light of the m patterns on the nodes of the pyramid; 1 or 3 channels.
    joint : Measurements
        Measurements of all channels together, (n, channels (m + 2)).
    own : Measurements
        Those of each channel, (n, 3, m + 2).
    """

    grids: Grids
    code: NDArray[np.uint8]
    joint: Measurements
    own: Measurements


class Explained(NamedTuple):
    """What the recovered T says of the measurements; kernels write it.

    Attributes
    ----------
    response : (n, 3, m + 2) float32
        What the measurements would be according to T.
    kappa, misfit : (n, 3) float64
        As from :func:`~workflows.recovery.lobes.posterior.update`.
    nodes : (n, 3) int64
        Nodes of each row; a row for all channels comes first.
    """

    response: NDArray[np.float32]
    kappa: NDArray[np.float64]
    misfit: NDArray[np.float64]
    nodes: NDArray[np.int64]


class Fits(NamedTuple):
    """The four fits of a pixel.

    Attributes
    ----------
    lobes : (4, most, 6) float64
    level : (4, most) int64
    offset : (4, 3) float64
        As in :class:`~workflows.recovery.lobes.mixture.Mixture`.
    k : (4,) int64
        Lobes of each fit; 0 where there is none.
    objective : (4,) float64
        -2 ln likelihood.
    """

    lobes: NDArray[np.float64]
    level: NDArray[np.int64]
    offset: NDArray[np.float64]
    k: NDArray[np.int64]
    objective: NDArray[np.float64]


class Space(NamedTuple):
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
def fit_again(
    shown: Shown,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    objective: float,
    options: LobesOptions,
    space: Space,
) -> tuple[int, float]:
    """Fit the lobes of a pixel a second time, starting from the moments of the posterior mean about them.

    A lobe that is too wide and slightly turned cannot become narrow by small steps. What the posterior leaves of it is
    narrow already.

    Parameters
    ----------
    shown, y, variance
        As in :func:`~workflows.recovery.lobes.mixture.refine`.
    mixture : Mixture
        Changed if the new fit is better.
    k : int
    objective : float
        -2 ln likelihood of the lobes.
    options : LobesOptions
    space : Space

    Returns
    -------
    k : int
    objective : float
    """
    tried = Mixture(mixture.lobes.copy(), mixture.level.copy(), mixture.offset.copy())
    n = spread_lobes(shown.grids, tried, k, options.resolution, space.node, space.weight, space.end)
    A = space.rows[: n * y.size].reshape(n, y.size)
    rows_of(shown, space.node, n, A)
    # a literal would have `update` compiled once more
    passes = np.int64(1)
    update(A, space.weight[:n], y, variance, shown.groups, tried.offset, passes, options.gradients)
    gather_lobes(shown.grids, space.node, space.weight, space.end, tried, k, options.fit_resolution)
    found, _, new = fit(shown, y, variance, tried, k, options)
    if new + price(shown.grids, tried.level, found) >= objective + price(shown.grids, mixture.level, k):
        return k, objective
    copy_mixture(found, shown.groups, tried, mixture)
    return found, new


@njit(nogil=True, cache=True)
def measurements_of(pixels: Pixels, p: int, c: int) -> tuple[Shown, NDArray[np.float32], NDArray[np.float32]]:
    """The patterns that fit c of pixel p is made from, its measurements and their variances."""
    grids, code, joint, own = pixels
    m = own.value.shape[2] - 2
    groups = code.shape[1] // m
    if c == _ALL:
        return Shown(grids, code, 0, groups, m), joint.value[p], joint.variance[p]
    return Shown(grids, code, c * m if groups == 3 else 0, 1, m), own.value[p, c], own.variance[p, c]


@njit(nogil=True, cache=True, inline="always")
def leading_channel(variance: NDArray[np.float32]) -> int:
    """The channel whose measurements are the most precise, from the variances (3, m + 2) of a pixel."""
    lead, highest = _ALL, -1.0
    for c in range(3):
        precision = 0.0
        for j in range(variance.shape[1]):
            precision += 1 / variance[c, j]
        if precision > highest:
            lead, highest = c, precision
    return lead


@njit(nogil=True, cache=True, inline="always")
def fit_pixel(pixels: Pixels, p: int, apart: bool, options: LobesOptions, fits: Fits, space: Space) -> None:
    """Write the fits of a pixel that are needed.

    These are the one of all channels, and under patterns of three colours also those of each channel; or, where the
    channels are apart, those of each channel alone. The most precise one comes first, and the others start from its
    lobes.
    """
    own = pixels.own.variance[p]
    groups = pixels.code.shape[1] // (own.shape[1] - 2)
    fits.offset[:] = 0
    fits.k[:], fits.objective[:] = 0, 0
    lead = leading_channel(own) if apart else _ALL
    for turn in range(-1, 3):
        c = lead if turn < 0 else turn
        if turn == lead or (c < _ALL and (np.isinf(own[c]).all() or (lead == _ALL and groups == 1))):
            continue
        mixture = Mixture(fits.lobes[c], fits.level[c], fits.offset[c])
        if turn >= 0:
            fits.k[c] = fits.k[lead]
            first = Mixture(fits.lobes[lead], fits.level[lead], fits.offset[lead])
            copy_mixture(fits.k[lead], np.int64(0), first, mixture)
        shown, y, variance = measurements_of(pixels, p, c)
        k, kappa, objective = fit(shown, y, variance, mixture, fits.k[c], options)
        if kappa > options.doubt:
            k, objective = fit_again(shown, y, variance, mixture, k, objective, options, space)
        fits.k[c], fits.objective[c] = k, objective


@njit(nogil=True, cache=True, inline="always")
def prefers_channels(fits: Fits, size: int) -> bool:
    """Whether a T for each channel explains a pixel better than one T for all, given `size` measurements.

    Decided by Bayes' information criterion, with a kappa for each T; the channels' lobes are near the common ones.
    """
    each = math.log(size)
    together = fits.objective[_ALL] + each * (PARAMETERS * fits.k[_ALL] + 1)
    apart = 0.0
    for c in range(3):
        apart += fits.objective[c] + each * (PARAMETERS * fits.k[c] + 1)
    better: bool = apart < together
    return better


@njit(nogil=True, cache=True, inline="always")
def finish_fit(
    pixels: Pixels, p: int, c: int, options: LobesOptions, fits: Fits, space: Space, explained: Explained
) -> int:
    """Write the posterior mean about the lobes of a fit to `space`, and what it explains; returns its nodes."""
    shown, y, variance = measurements_of(pixels, p, c)
    mixture = Mixture(fits.lobes[c], fits.level[c], fits.offset[c])
    n: int = spread_lobes(
        shown.grids, mixture, fits.k[c], options.resolution, space.node, space.weight, space.end
    )
    A, weight = space.rows[: n * y.size].reshape(n, y.size), space.weight[:n]
    rows_of(shown, space.node, n, A)
    kappa, misfit = update(
        A, weight, y, variance, shown.groups, mixture.offset, options.passes, options.gradients
    )
    f = np.zeros_like(y)
    for i in range(n):
        subtract(f, -weight[i], A[i])
    for d in range(3):
        if c in (_ALL, d):
            explained.kappa[p, d], explained.misfit[p, d] = kappa, misfit
            first = d * (shown.m + 2) if shown.groups == 3 else 0
            for j in range(shown.m + 2):
                explained.response[p, d, j] = f[first + j]
    return n


@njit(nogil=True, cache=True)
def recover_pixels(
    pixels: Pixels, apart: NDArray[np.bool_], options: LobesOptions, explained: Explained
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Recover T of some pixels, one for all channels or one for each.

    Parameters
    ----------
    pixels : Pixels
    apart : (n,) bool
        Whether each channel gets its own T. Under patterns of three colours it is decided here, and written.
    options : LobesOptions
    explained : Explained
        Written.

    Returns
    -------
    node : (explained.nodes.sum(),) int64
    weight : (explained.nodes.sum(),) float32
    """
    n, size = pixels.joint.value.shape
    most, groups = options.most_lobes, pixels.code.shape[1] // (pixels.own.value.shape[2] - 2)
    fits = Fits(
        np.empty((4, most, PARAMETERS)),
        np.empty((4, most), np.int64),
        np.zeros((4, 3)),
        np.zeros(4, np.int64),
        np.zeros(4),
    )
    space = Space(
        np.empty(most * NODES, np.int64),
        np.empty(most * NODES, np.float32),
        np.empty(most, np.int64),
        np.empty(most * NODES * size, np.float32),
    )
    node, weight, end = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.float32), 0
    for p in range(n):
        fit_pixel(pixels, p, apart[p], options, fits, space)
        if groups == 3:
            apart[p] = prefers_channels(fits, size)
        explained.nodes[p] = 0
        for c in range(0 if apart[p] else _ALL, _ALL if apart[p] else _ALL + 1):
            if fits.k[c] == 0:
                continue
            found = finish_fit(pixels, p, c, options, fits, space, explained)
            while end + found > node.size:
                node = np.concatenate((node, np.empty_like(node)))
                weight = np.concatenate((weight, np.empty_like(weight)))
            for i in range(found):
                if space.weight[i] >= options.least_weight:
                    node[end], weight[end] = space.node[i], space.weight[i]
                    explained.nodes[p, c % 3] += 1
                    end += 1
    return node[:end], weight[:end]
