"""The paper's Gaussian prior: oriented Gaussians fitted on the fly to the clusters of a T, and T filtered by them."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.clusters import LEAST_MASS, PARAMETERS, add_moments, merge_clusters, spread
from workflows.recovery.dgsr.groups import Rows
from workflows.recovery.dgsr.options import Constants
from workflows.recovery.dgsr.pursuit import System
from workflows.recovery.solvers import inner, posterior_mean, stack_rows, subtract


@njit(nogil=True, cache=True)
def filter_rows(system: System, found: Rows, constants: Constants) -> Rows:
    """Filter sparse rows by Gaussians, those that they explain better than the row's own cells do.

    Parameters
    ----------
    system : System
    found : Rows
        A cell of weight 0 was a candidate.
    constants : Constants

    Returns
    -------
    Rows
        Cells need not have been candidates.

    Notes
    -----
    k cells out of s candidates cost ``2 k ln s`` and their misfit ``n ln(|f - A t|^2 / n)``, as if at least the
    noise's; Gaussians cost what :func:`filter_row` says.
    """
    light, columns, rows, source, scale, target, variance = system
    begin, cell, weight = found
    channels = scale.shape[1] // light.shape[2]
    field = np.zeros((constants.clusters, rows, columns), np.float32)
    n = source.size
    new_begin = np.zeros(n + 1, np.int64)
    new_cell, new_weight = np.empty(1024, np.int32), np.empty(1024, np.float32)
    end = 0
    for p in range(n):
        own, x = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        lit = np.flatnonzero(x > 0)
        kept_cell, kept = own[lit], x[lit]
        if lit.size > 0:
            seen = light[source[p] : source[p] + channels]
            matrix = np.empty((lit.size, target.shape[1]), np.float32)
            stack_rows(seen, kept_cell, scale[p], matrix)
            residual = target[p].copy()
            for j in range(lit.size):
                subtract(residual, kept[j], matrix[j])
            m = inner(scale[p], scale[p])
            plain = m * math.log(max(inner(residual, residual) / m, variance[p]))
            plain += 2 * math.log(max(own.size, 2)) * lit.size
            score, filtered_cell, filtered = filter_row(
                seen, scale[p], target[p], variance[p], columns, kept_cell, kept, constants, field
            )
            if score < plain:
                kept_cell, kept = filtered_cell, filtered
        while end + kept.size > new_cell.size:
            new_cell = np.concatenate((new_cell, np.empty_like(new_cell)))
            new_weight = np.concatenate((new_weight, np.empty_like(new_weight)))
        for j in range(kept.size):
            new_cell[end], new_weight[end] = kept_cell[j], kept[j]
            end += 1
        new_begin[p + 1] = end
    return Rows(new_begin, new_cell[:end].copy(), new_weight[:end].copy())


@njit(nogil=True, cache=True)
def filter_row(
    light: NDArray[np.float32],
    scale: NDArray[np.float32],
    target: NDArray[np.float32],
    variance: float,
    columns: int,
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    constants: Constants,
    field: NDArray[np.float32],
) -> tuple[float, NDArray[np.int32], NDArray[np.float32]]:
    """Filter a T by oriented Gaussians, again and again fitted to its clusters.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the channels that the measurements belong to, 0 to 1.
    scale, target : (channels * m,) float32
        The measurements in +-1 form, each scaled so that all have one variance, and the scales.
    variance : float
        That variance.
    columns : int
        Columns of the grid.
    cell, weight : (s,) int32, float32
        The T to start from, s at least 1, of positive weights.
    constants : Constants
    field : (clusters, rows, columns) float32
        Working space, all zero before and after.

    Returns
    -------
    score : float
        Minus twice the log-likelihood of the best Gaussians, plus 2 for each of their parameters.
    cell, weight : (s,) int32, float32
        The T filtered by them.

    Notes
    -----
    With m the Gaussians' mass on each cell, together 1, T has the prior ``T ~ N(m, k diag m)`` (eq. 9): only cells
    inside a Gaussian may be lit, the more the more of it they hold. Its mean given the measurements f = A t of
    variance v is ``t = m + M A' (A M A' + v / k)^-1 (f - A m)``, M = diag m, cut off at 0. The most likely k has
    ``|f - A m|^2 = n (v + k)``, as each of the n rows of A is of +-1. The next Gaussians have the moments of this t.

    The clusters are Ward's, from every cell its own to `clusters` and fewer; the best number is kept.
    """
    clusters, reach, fits, stall = constants.clusters, constants.reach, constants.fits, constants.stall
    steps, precision = constants.steps, constants.precision
    n = inner(scale, scale)
    moments = np.zeros((cell.size, PARAMETERS))
    for j in range(cell.size):
        add_moments(moments[j], cell[j], columns, weight[j])
    count = cell.size
    best_score = np.inf
    best_cell, best_weight = cell, weight
    while True:
        count = merge_clusters(moments, count, clusters)
        gaussians = moments[:count].copy()
        lobes = count
        before = np.inf
        for _ in range(fits):
            inside, mass = spread(gaussians[:lobes], columns, reach, field)
            if inside.size == 0:
                break
            matrix = np.empty((inside.size, target.size), np.float32)
            stack_rows(light, inside, scale, matrix)
            mean = np.zeros(inside.size, np.float32)
            for i in range(lobes):
                for j in range(inside.size):
                    mean[j] += mass[i, j]
            residual = target.copy()
            for j in range(inside.size):
                subtract(residual, mean[j], matrix[j])
            misfit = inner(residual, residual)
            looseness = max(misfit / n - variance, 0.0)
            t = posterior_mean(matrix, residual, mean, variance, looseness, steps, precision)
            score = n * math.log(max(misfit / n, variance)) + 2 * PARAMETERS * lobes
            if score < best_score:
                best_score, best_cell, best_weight = score, inside, t
            if misfit >= (1 - stall) * before:
                break
            before = misfit
            kept = 0
            for i in range(lobes):
                for k in range(PARAMETERS):
                    gaussians[kept, k] = 0
                for j in range(inside.size):
                    if mass[i, j] > 0:
                        add_moments(gaussians[kept], inside[j], columns, t[j] * mass[i, j] / mean[j])
                kept += gaussians[kept, 0] > LEAST_MASS
            lobes = kept
        if count == 1:
            break
        clusters = count - 1
    return best_score, best_cell, best_weight
