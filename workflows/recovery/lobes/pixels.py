"""The posterior means of T of pixels, given their fits, and how well they explain the measurements."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.fits import (
    ALL,
    Fits,
    NodeBuffers,
    Pixels,
    fit_of,
    measurements_of,
    spread_to,
)
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.lobes.posterior.mean import add_row_moments, update
from workflows.recovery.lobes.strays import subtract_strays, write_strays

# Initial capacity for the entries of rows.
_CAPACITY = 1 << 16


class Diagnostics(NamedTuple):
    """How well the recovered T explains the measurements; kernels write it.

    Attributes
    ----------
    response, stray : (n, 3, m + 2) float32
        Predictions of the measurements: by T, and by stray light that is not constant.
    kappa, misfit : (n, 3) float64
        As from :func:`~workflows.recovery.lobes.posterior.mean.update`.
    nodes : (n, 3) int64
        Number of nodes of each row; a row that serves all channels comes first.
    """

    response: NDArray[np.float32]
    stray: NDArray[np.float32]
    kappa: NDArray[np.float64]
    misfit: NDArray[np.float64]
    nodes: NDArray[np.int64]


@njit(nogil=True, cache=True, inline="always")
def finish_fit(
    pixels: Pixels,
    p: int,
    c: int,
    share: float,
    options: LobesOptions,
    fits: Fits,
    buffers: NodeBuffers,
    diagnostics: Diagnostics,
) -> int:
    """Write the posterior mean for the lobes of a fit to `buffers`, and return its number of nodes.

    Its diagnostics are added, times the fit's share of T.
    """
    patterns, y, variance = measurements_of(pixels, p, c)
    mixture, lobes = fit_of(fits, p, c), fits.k[p, c]
    stray = np.zeros_like(y)
    count, size = patterns.strays.shape
    offset = mixture.stray[::count].copy()
    if count > 1:
        write_strays(patterns.strays, mixture.stray, 1, stray)
        y, variance, offset[:] = y.copy(), variance.copy(), 0
        subtract_strays(y, variance, stray, size)
    A = spread_to(buffers, patterns, mixture, lobes, options.resolution, merged=True)
    n: int = len(A)
    weight, end = buffers.weight[:n], buffers.end[:lobes]
    kappa, misfit = update(
        A, weight, end, y, variance, patterns.strays[:1], offset, options.passes, options.gradients
    )
    f = np.zeros_like(y)
    add_row_moments(A, weight, f, np.zeros_like(f))
    for d in range(3):
        if c in (ALL, d):
            diagnostics.kappa[p, d] += share * kappa
            diagnostics.misfit[p, d] += share * misfit
            first = d * (patterns.m + 2) if patterns.groups == 3 else 0
            for j in range(patterns.m + 2):
                diagnostics.response[p, d, j] += np.float32(share) * f[first + j]
                diagnostics.stray[p, d, j] += np.float32(share) * stray[first + j]
    return n


@njit(nogil=True, cache=True)
def merge_rows(
    node: NDArray[np.int64], weight: NDArray[np.float32], least: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Sort the entries of a row by node, add the weights of those that are alike, and drop those below the least."""
    order, end = np.argsort(node, kind="mergesort"), 0
    merged, total = np.empty_like(node), np.empty_like(weight)
    for i in order:
        if end > 0 and merged[end - 1] == node[i]:
            total[end - 1] += weight[i]
        else:
            merged[end], total[end] = node[i], weight[i]
            end += 1
    kept = total[:end] >= least
    return merged[:end][kept], total[:end][kept]


@njit(nogil=True, cache=True)
def finish_pixels(
    pixels: Pixels,
    first: int,
    last: int,
    share: NDArray[np.float64],
    fits: Fits,
    options: LobesOptions,
    buffers: NodeBuffers,
    diagnostics: Diagnostics,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Compute T of some pixels in succession, one for all channels, one for each, or a mean of both for each.

    Parameters
    ----------
    pixels : Pixels
    first, last : int
        The first pixel, and the one after the last.
    share : (n,) float64
        How much of T is that of each channel, 0 to 1; the rest is the common one.
    fits : Fits
        Lobes are moved to the levels for `options.resolution`.
    options : LobesOptions
    buffers : NodeBuffers
    diagnostics : Diagnostics
        Zeros; written.

    Returns
    -------
    node : (diagnostics.nodes[first:last].sum(),) int64
    weight : (diagnostics.nodes[first:last].sum(),) float32
        The entries of all rows, row after row; nodes ascend within a row.
    """
    node, weight, end = np.empty(_CAPACITY, np.int64), np.empty(_CAPACITY, np.float32), 0
    for p in range(first, last):
        common_node, common_weight = node[:0], weight[:0]
        for i in range(ALL + 1):
            c = (i + ALL) % (ALL + 1)  # that of all channels first
            part = 1 - share[p] if c == ALL else share[p]
            if part == 0 or fits.k[p, c] == 0:
                continue
            found = finish_fit(pixels, p, c, part, options, fits, buffers, diagnostics)
            of_row, weights = buffers.node[:found], buffers.weight[:found] * np.float32(part)
            if c == ALL and part < 1:
                common_node, common_weight = of_row.copy(), weights
                continue
            if part < 1:
                of_row = np.concatenate((of_row, common_node))
                weights = np.concatenate((weights, common_weight))
            of_row, weights = merge_rows(of_row, weights, options.least_weight)
            new = end + of_row.size
            while new > node.size:
                node = np.concatenate((node, np.empty_like(node)))
                weight = np.concatenate((weight, np.empty_like(weight)))
            node[end:new], weight[end:new] = of_row, weights
            diagnostics.nodes[p, c % 3], end = new - end, new
    return node[:end], weight[:end]
