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
    fits_of_transport,
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
    options: LobesOptions,
    fits: Fits,
    buffers: NodeBuffers,
    diagnostics: Diagnostics,
) -> int:
    """Write the posterior mean for the lobes of a fit to `buffers`, and its diagnostics; return its number of nodes."""
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
            diagnostics.kappa[p, d], diagnostics.misfit[p, d] = kappa, misfit
            first = d * (patterns.m + 2) if patterns.groups == 3 else 0
            for j in range(patterns.m + 2):
                diagnostics.response[p, d, j] = f[first + j]
                diagnostics.stray[p, d, j] = stray[first + j]
    return n


@njit(nogil=True, cache=True)
def finish_pixels(
    pixels: Pixels,
    first: int,
    last: int,
    separate: NDArray[np.bool_],
    fits: Fits,
    options: LobesOptions,
    buffers: NodeBuffers,
    diagnostics: Diagnostics,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Compute T of some pixels in succession, one for all channels or one for each.

    Parameters
    ----------
    pixels : Pixels
    first, last : int
        The first pixel, and the one after the last.
    separate : (n,) bool
        Whether each channel gets its own T.
    fits : Fits
        Lobes are moved to the levels for `options.resolution`.
    options : LobesOptions
    buffers : NodeBuffers
    diagnostics : Diagnostics
        Written.

    Returns
    -------
    node : (diagnostics.nodes[first:last].sum(),) int64
    weight : (diagnostics.nodes[first:last].sum(),) float32
        The entries of all rows, row after row; nodes ascend within a row.
    """
    node, weight, end = np.empty(_CAPACITY, np.int64), np.empty(_CAPACITY, np.float32), 0
    for p in range(first, last):
        for c in fits_of_transport(separate[p]):
            if fits.k[p, c] == 0:
                continue
            found = finish_fit(pixels, p, c, options, fits, buffers, diagnostics)
            while end + found > node.size:
                node = np.concatenate((node, np.empty_like(node)))
                weight = np.concatenate((weight, np.empty_like(weight)))
            of_row, weights, begin = buffers.node, buffers.weight, end
            for i in np.argsort(of_row[:found]):
                if weights[i] >= options.least_weight:
                    node[end], weight[end] = of_row[i], weights[i]
                    end += 1
            diagnostics.nodes[p, c % 3] += end - begin
    return node[:end], weight[:end]
