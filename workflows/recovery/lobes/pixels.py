"""Recovery of pixels one by one: their fits of lobes, and the posterior mean of T given these."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fits import (
    ALL,
    Fits,
    NodeBuffers,
    Pixels,
    fit_pixel,
    measurements_of,
    prefers_channels,
)
from workflows.recovery.lobes.footprint import NODES, PARAMETERS
from workflows.recovery.lobes.levenberg_marquardt import fit_amounts
from workflows.recovery.lobes.mixture import Mixture
from workflows.recovery.lobes.nodes import node_responses, spread_lobes
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.lobes.posterior.mean import update
from workflows.recovery.lobes.strays import subtract_strays, write_strays
from workflows.recovery.solvers import subtract

# Initial capacity for the entries of a block's rows.
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

    def at(self, pixels: slice | NDArray[np.bool_]) -> "Diagnostics":
        """Those of some pixels."""
        return Diagnostics(
            self.response[pixels],
            self.stray[pixels],
            self.kappa[pixels],
            self.misfit[pixels],
            self.nodes[pixels],
        )


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
    mixture = Mixture(fits.lobes[c], fits.level[c], fits.stray[c])
    stray = np.zeros_like(y)
    count, size = patterns.strays.shape
    offset = mixture.stray[::count].copy()
    if count > 1:
        fit_amounts(patterns, y, variance, mixture, fits.k[c])
        write_strays(patterns.strays, mixture.stray, 1, stray)
        y, variance, offset[:] = y.copy(), variance.copy(), 0
        subtract_strays(y, variance, stray, size)
    n: int = spread_lobes(
        patterns.grids, mixture, fits.k[c], options.resolution, buffers.node, buffers.weight, buffers.end
    )
    A, weight = buffers.rows[: n * y.size].reshape(n, y.size), buffers.weight[:n]
    node_responses(patterns, buffers.node, n, A)
    end = buffers.end[: fits.k[c]]
    kappa, misfit = update(
        A, weight, end, y, variance, patterns.strays[:1], offset, options.passes, options.gradients
    )
    f = np.zeros_like(y)
    for i in range(n):
        subtract(f, -weight[i], A[i])
    for d in range(3):
        if c in (ALL, d):
            diagnostics.kappa[p, d], diagnostics.misfit[p, d] = kappa, misfit
            first = d * (patterns.m + 2) if patterns.groups == 3 else 0
            for j in range(patterns.m + 2):
                diagnostics.response[p, d, j] = f[first + j]
                diagnostics.stray[p, d, j] = stray[first + j]
    return n


@njit(nogil=True, cache=True)
def recover_pixels(
    pixels: Pixels, separate: NDArray[np.bool_], options: LobesOptions, diagnostics: Diagnostics
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Recover T of n pixels, one for all channels or one for each.

    Parameters
    ----------
    pixels : Pixels
    separate : (n,) bool
        Whether each channel gets its own T. Under coloured patterns this is decided here and written.
    options : LobesOptions
    diagnostics : Diagnostics
        Written.

    Returns
    -------
    node : (diagnostics.nodes.sum(),) int64
    weight : (diagnostics.nodes.sum(),) float32
        The entries of all rows, row after row.
    """
    n, size = pixels.joint.value.shape
    most, groups = options.most_lobes, pixels.code.shape[1] // (pixels.own.value.shape[2] - 2)
    fits = Fits(
        np.empty((4, most, PARAMETERS)),
        np.empty((4, most), np.int64),
        np.zeros((4, 3 * len(pixels.strays))),
        np.zeros(4, np.int64),
        np.zeros(4),
    )
    buffers = NodeBuffers(
        np.empty(most * NODES, np.int64),
        np.empty(most * NODES, np.float32),
        np.empty(most, np.int64),
        np.empty(most * NODES * size, np.float32),
    )
    node, weight, end = np.empty(_CAPACITY, np.int64), np.empty(_CAPACITY, np.float32), 0
    for p in range(n):
        fit_pixel(pixels, p, separate[p], options, fits, buffers)
        if groups == 3:
            separate[p] = prefers_channels(fits, size)
        diagnostics.nodes[p] = 0
        for c in range(0 if separate[p] else ALL, ALL if separate[p] else ALL + 1):
            if fits.k[c] == 0:
                continue
            found = finish_fit(pixels, p, c, options, fits, buffers, diagnostics)
            while end + found > node.size:
                node = np.concatenate((node, np.empty_like(node)))
                weight = np.concatenate((weight, np.empty_like(weight)))
            for i in range(found):
                if buffers.weight[i] >= options.least_weight:
                    node[end], weight[end] = buffers.node[i], buffers.weight[i]
                    diagnostics.nodes[p, c % 3] += 1
                    end += 1
    return node[:end], weight[:end]
