"""The recovery of one pixel after another: its lobes, once more where they miss, and the posterior mean about them."""

import math

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
from workflows.recovery.normalise import Measured
from workflows.recovery.pyramid import Grids
from workflows.recovery.solvers import subtract

# Nodes that the rows of a block are first given room for.
_ROOM = 1 << 16


@njit(nogil=True, cache=True)
def fit_again(
    shown: Shown,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    worth: float,
    options: LobesOptions,
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
    room: NDArray[np.float32],
) -> tuple[int, float]:
    """Fit the lobes of a pixel once more, from the moments of the posterior mean about them.

    A lobe that is too wide, and turned a little, can't become narrow by small steps; what the posterior leaves of it
    is narrow already.

    Parameters
    ----------
    shown, y, variance
        As in :func:`~workflows.recovery.lobes.mixture.refine`.
    mixture : Mixture
        Changed, where the new fit is the better one.
    k : int
    worth : float
        -2 ln likelihood of the lobes.
    options : LobesOptions
    node, weight, room
        Working space: for all lobes' nodes, and the rows of these.

    Returns
    -------
    k : int
    worth : float
    """
    grids, groups = shown.grids, shown.groups
    tried = Mixture(mixture.lobes.copy(), mixture.level.copy(), mixture.offset.copy())
    end = np.empty(k, np.int64)
    n = spread_lobes(grids, tried, k, options.resolution, node, weight, end)
    A = room[: n * y.size].reshape(n, y.size)
    rows_of(shown, node, n, A)
    update(A, weight[:n], y, variance, groups, tried.offset, 1, options.gradients)
    gather_lobes(grids, node, weight, end, tried, k, options.fit_resolution)
    found, _, new = fit(shown, y, variance, tried, k, options)
    if new + price(grids, tried.level, found) >= worth + price(grids, mixture.level, k):
        return k, worth
    copy_mixture(found, groups, tried, mixture)
    return found, new


@njit(nogil=True, cache=True)
def measurements_of(
    grids: Grids, code: NDArray[np.uint8], joint: Measured, own: Measured, p: int, c: int
) -> tuple[Shown, NDArray[np.float32], NDArray[np.float32]]:
    """What channel c of pixel p saw, its measurements and their variances; those of all channels together if c is 3."""
    m = own.value.shape[2] - 2
    groups = code.shape[1] // m
    if c == 3:
        return Shown(grids, code, 0, groups, m), joint.value[p], joint.variance[p]
    return Shown(grids, code, c * m if groups == 3 else 0, 1, m), own.value[p, c], own.variance[p, c]


@njit(nogil=True, cache=True)
def recover_pixels(
    grids: Grids,
    code: NDArray[np.uint8],
    joint: Measured,
    own: Measured,
    apart: NDArray[np.bool_],
    options: LobesOptions,
    response: NDArray[np.float32],
    kappa: NDArray[np.float64],
    misfit: NDArray[np.float64],
    count: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Recover T of some pixels, one for all channels or one for each.

    Parameters
    ----------
    grids : Grids
    code : (nodes, channels m) uint8
        Light of the m patterns on the nodes of the pyramid; 1 or 3 channels.
    joint : Measured
        Measurements of all channels together, (n, channels (m + 2)).
    own : Measured
        Those of each channel, (n, 3, m + 2).
    apart : (n,) bool
        Whether each channel gets its own T; under patterns of three colours found out here, and written.
    options : LobesOptions
    response : (n, 3, m + 2) float32
        Written: what the measurements would be before T.
    kappa, misfit : (n, 3) float64
        Written, as from :func:`~workflows.recovery.lobes.posterior.update`.
    count : (n, 3) int64
        Written: nodes of each row; those of a row for all channels stand first.

    Returns
    -------
    node : (count.sum(),) int64
    weight : (count.sum(),) float32
    """
    pixels, size = joint.value.shape
    m, most = own.value.shape[2] - 2, options.most_lobes
    groups = code.shape[1] // m
    lobes, level, k = np.empty((4, most, PARAMETERS)), np.empty((4, most), np.int64), np.zeros(4, np.int64)
    offset, worth = np.zeros((4, 3)), np.zeros(4)
    node, weight = np.empty(most * NODES, np.int64), np.empty(most * NODES, np.float32)
    room, end = np.empty(node.size * size, np.float32), np.empty(most, np.int64)
    all_nodes, all_weights, written = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.float32), 0
    for p in range(pixels):
        offset[:] = 0
        k[:], worth[:] = 0, 0
        # 0 to 2: a channel; 3: all of them. The one that says most leads, and the others start from its lobes.
        lead = 3
        if apart[p]:
            most_said = -1.0
            for c in range(3):
                said = 0.0
                for j in range(m + 2):
                    said += 1 / own.variance[p, c, j]
                if said > most_said:
                    lead, most_said = c, said
        for turn in range(-1, 3):
            c = lead if turn < 0 else turn
            if turn == lead or (
                c < 3 and (np.isinf(own.variance[p, c]).all() or (lead == 3 and groups == 1))
            ):
                continue
            mixture = Mixture(lobes[c], level[c], offset[c])
            if turn >= 0:
                k[c] = k[lead]
                copy_mixture(k[lead], 0, Mixture(lobes[lead], level[lead], offset[lead]), mixture)
            shown, y, variance = measurements_of(grids, code, joint, own, p, c)
            k[c], left_out, worth[c] = fit(shown, y, variance, mixture, k[c], options)
            if left_out > options.doubt:
                k[c], worth[c] = fit_again(
                    shown, y, variance, mixture, k[c], worth[c], options, node, weight, room
                )
        if groups == 3:
            # Bayes' information criterion, with a kappa each; the channels' lobes are near the common ones
            each = math.log(size)
            fewer = worth[3] + each * (PARAMETERS * k[3] + 1)
            apart[p] = (worth[:3] + each * (PARAMETERS * k[:3] + 1)).sum() < fewer
        count[p] = 0
        for c in range(0 if apart[p] else 3, 3 if apart[p] else 4):
            if k[c] == 0:
                continue
            shown, y, variance = measurements_of(grids, code, joint, own, p, c)
            mixture = Mixture(lobes[c], level[c], offset[c])
            n = spread_lobes(grids, mixture, k[c], options.resolution, node, weight, end)
            A = room[: n * y.size].reshape(n, y.size)
            rows_of(shown, node, n, A)
            left_out, missed = update(
                A, weight[:n], y, variance, shown.groups, mixture.offset, options.passes, options.gradients
            )
            f = np.zeros_like(y)
            for i in range(n):
                subtract(f, -weight[i], A[i])
            for d in range(3):
                if c == 3 or c == d:
                    kappa[p, d], misfit[p, d] = left_out, missed
                    to = d * (m + 2) if shown.groups == 3 else 0
                    for j in range(m + 2):
                        response[p, d, j] = f[to + j]
            while written + n > all_nodes.size:
                all_nodes = np.concatenate((all_nodes, np.empty_like(all_nodes)))
                all_weights = np.concatenate((all_weights, np.empty_like(all_weights)))
            for i in range(n):
                if weight[i] >= options.least_weight:
                    all_nodes[written], all_weights[written] = node[i], weight[i]
                    count[p, c % 3] += 1
                    written += 1
    return all_nodes[:written], all_weights[:written]
