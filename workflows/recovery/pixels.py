"""The recovery of one pixel after another: its lobes, once more where they miss, and the posterior mean about them."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.footprint import NODES, PARAMETERS
from workflows.recovery.mixture import copy_lobes, price
from workflows.recovery.posterior import gather_lobes, rows_of, spread_lobes, update
from workflows.recovery.search import fit
from workflows.recovery.solvers import subtract

# Nodes that the rows of a block are first given room for.
_ROOM = 1 << 16


class Effort(NamedTuple):
    """The constants of :func:`~workflows.recovery.lobes.recover` that the kernels need."""

    most_lobes: int
    fit_resolution: float
    resolution: float
    rounds: int
    steps: int
    tolerance: float
    beam: int
    doubt: float
    passes: int
    gradients: int
    least_weight: float


@njit(nogil=True, cache=True)
def fit_again(
    code: NDArray[np.uint8],
    first: int,
    groups: int,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    lobes: NDArray[np.float64],
    level: NDArray[np.int64],
    k: int,
    offset: NDArray[np.float64],
    worth: float,
    effort: Effort,
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
    room: NDArray[np.float32],
) -> tuple[int, float]:
    """Fit the lobes of a pixel once more, from the moments of the posterior mean about them.

    A lobe that is too wide, and turned a little, can't become narrow by small steps; what the posterior leaves of it
    is narrow already.

    Parameters
    ----------
    code, first, groups, columns, rows, starts, y, variance
        As in :func:`~workflows.recovery.mixture.refine`.
    lobes, level, k, offset
        Changed, where the new fit is the better one.
    worth : float
        -2 ln likelihood of the lobes.
    effort : Effort
    node, weight, room
        Working space: for all lobes' nodes, and the rows of these.

    Returns
    -------
    k : int
    worth : float
    """
    tried, tried_level, tried_offset = lobes.copy(), level.copy(), offset.copy()
    end = np.empty(k, np.int64)
    n = spread_lobes(columns, rows, starts, tried, tried_level, k, effort.resolution, node, weight, end)
    A = room[: n * y.size].reshape(n, y.size)
    rows_of(code, first, groups, y.size // groups - 2, node, n, A)
    update(A, weight[:n], y, variance, groups, tried_offset, 1, effort.gradients)
    gather_lobes(columns, starts, node, weight, end, tried, tried_level, k, effort.fit_resolution)
    found, _, new = fit(
        code, first, groups, columns, rows, starts, y, variance, tried, tried_level, k, tried_offset,
        effort.most_lobes, effort.fit_resolution, effort.rounds, effort.steps, effort.tolerance, effort.beam,
    )  # fmt: skip
    if new + price(columns, rows, tried_level, found) >= worth + price(columns, rows, level, k):
        return k, worth
    copy_lobes(found, tried, tried_level, lobes, level)
    for g in range(groups):
        offset[g] = tried_offset[g]
    return found, new


@njit(nogil=True, cache=True)
def recover_pixels(
    code: NDArray[np.uint8],
    m: int,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    joint: NDArray[np.float32],
    joint_variance: NDArray[np.float32],
    own: NDArray[np.float32],
    own_variance: NDArray[np.float32],
    apart: NDArray[np.bool_],
    effort: Effort,
    response: NDArray[np.float32],
    kappa: NDArray[np.float64],
    misfit: NDArray[np.float64],
    count: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Recover T of some pixels, one for all channels or one for each.

    Parameters
    ----------
    code : (nodes, channels m) uint8
        Light of the m patterns on the nodes of the pyramid; 1 or 3 channels.
    m : int
    columns, rows, starts
        Of the pyramid.
    joint, joint_variance : (n, channels (m + 2)) float32
        Measurements of all channels together, and their variances.
    own, own_variance : (n, 3, m + 2) float32
        Those of each channel.
    apart : (n,) bool
        Whether each channel gets its own T; under patterns of three colours found out here, and written.
    effort : Effort
    response : (n, 3, m + 2) float32
        Written: what the measurements would be before T.
    kappa, misfit : (n, 3) float64
        Written, as from :func:`~workflows.recovery.posterior.update`.
    count : (n, 3) int64
        Written: nodes of each row; those of a row for all channels stand first.

    Returns
    -------
    node : (count.sum(),) int64
    weight : (count.sum(),) float32
    """
    groups, most = code.shape[1] // m, effort.most_lobes
    lobes, level, k = np.empty((4, most, PARAMETERS)), np.empty((4, most), np.int64), np.zeros(4, np.int64)
    offset, worth = np.zeros((4, 3)), np.zeros(4)
    node, weight = np.empty(most * NODES, np.int64), np.empty(most * NODES, np.float32)
    room, end = np.empty(node.size * joint.shape[1], np.float32), np.empty(most, np.int64)
    all_nodes, all_weights, written = np.empty(_ROOM, np.int64), np.empty(_ROOM, np.float32), 0
    for p in range(joint.shape[0]):
        offset[:] = 0
        k[:], worth[:] = 0, 0
        # 0 to 2: a channel; 3: all of them. The one that says most leads, and the others start from its lobes.
        lead = 3
        if apart[p]:
            most_said = -1.0
            for c in range(3):
                said = 0.0
                for j in range(m + 2):
                    said += 1 / own_variance[p, c, j]
                if said > most_said:
                    lead, most_said = c, said
        for turn in range(-1, 3):
            c = lead if turn < 0 else turn
            if turn == lead or (
                c < 3 and (np.isinf(own_variance[p, c]).all() or (lead == 3 and groups == 1))
            ):
                continue
            if turn >= 0:
                k[c] = k[lead]
                copy_lobes(k[lead], lobes[lead], level[lead], lobes[c], level[c])
            first, my_groups = (c * m if groups == 3 else 0, 1) if c < 3 else (0, groups)
            y, variance = (own[p, c], own_variance[p, c]) if c < 3 else (joint[p], joint_variance[p])
            k[c], left_out, worth[c] = fit(
                code, first, my_groups, columns, rows, starts, y, variance, lobes[c], level[c],
                k[c], offset[c], most, effort.fit_resolution, effort.rounds, effort.steps,
                effort.tolerance, effort.beam,
            )  # fmt: skip
            if left_out > effort.doubt:
                k[c], worth[c] = fit_again(
                    code, first, my_groups, columns, rows, starts, y, variance, lobes[c], level[c], k[c],
                    offset[c], worth[c], effort, node, weight, room,
                )  # fmt: skip
        if groups == 3:
            # Bayes' information criterion, with a kappa each; the channels' lobes are near the common ones
            each = math.log(joint.shape[1])
            fewer = worth[3] + each * (PARAMETERS * k[3] + 1)
            apart[p] = (worth[:3] + each * (PARAMETERS * k[:3] + 1)).sum() < fewer
        count[p] = 0
        for c in range(0 if apart[p] else 3, 3 if apart[p] else 4):
            if k[c] == 0:
                continue
            first, my_groups = (c * m if groups == 3 else 0, 1) if c < 3 else (0, groups)
            y, variance = (own[p, c], own_variance[p, c]) if c < 3 else (joint[p], joint_variance[p])
            n = spread_lobes(
                columns, rows, starts, lobes[c], level[c], k[c], effort.resolution, node, weight, end
            )
            A = room[: n * y.size].reshape(n, y.size)
            rows_of(code, first, my_groups, m, node, n, A)
            left_out, missed = update(
                A, weight[:n], y, variance, my_groups, offset[c], effort.passes, effort.gradients
            )
            f = np.zeros(my_groups * (m + 2), np.float32)
            for i in range(n):
                subtract(f, -weight[i], A[i])
            for d in range(3):
                if c == 3 or c == d:
                    kappa[p, d], misfit[p, d] = left_out, missed
                    to = d * (m + 2) if my_groups == 3 else 0
                    for j in range(m + 2):
                        response[p, d, j] = f[to + j]
            while written + n > all_nodes.size:
                all_nodes = np.concatenate((all_nodes, np.empty_like(all_nodes)))
                all_weights = np.concatenate((all_weights, np.empty_like(all_weights)))
            for i in range(n):
                if weight[i] >= effort.least_weight:
                    all_nodes[written], all_weights[written] = node[i], weight[i]
                    count[p, c % 3] += 1
                    written += 1
    return all_nodes[:written], all_weights[:written]
