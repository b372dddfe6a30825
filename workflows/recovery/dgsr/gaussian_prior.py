"""The paper's Gaussian prior: oriented Gaussians fitted to the clusters of each row of T, which then filter the row."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.clusters.gaussians import (
    LEAST_MASS,
    PARAMETERS,
    add_moments,
    integrate_gaussians,
    merge_clusters,
)
from workflows.recovery.dgsr.groups import Rows
from workflows.recovery.dgsr.options import Constants
from workflows.recovery.dgsr.pursuit import Problem, System, problem_of
from workflows.recovery.solvers import inner, posterior_mean, stack_rows, subtract


@njit(nogil=True, cache=True)
def filter_rows(system: System, rows: Rows, constants: Constants) -> Rows:
    """Filter sparse rows by Gaussians where these explain the measurements better than the row's own cells.

    Parameters
    ----------
    system : System
    rows : Rows
        Solved rows. Candidates that were not chosen have weight 0.
    constants : Constants

    Returns
    -------
    Rows
        The filtered rows, whose cells need not have been candidates.
    """
    begin, cell, weight = rows
    field = np.zeros((constants.clusters, system.rows, system.columns), np.float32)
    n = system.source.size
    new_begin = np.zeros(n + 1, np.int64)
    new_cell, new_weight = np.empty(1024, np.int32), np.empty(1024, np.float32)
    end = 0
    for p in range(n):
        candidates, x = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        support = np.flatnonzero(x > 0)
        kept_cell, kept = candidates[support], x[support]
        if support.size > 0:
            problem = problem_of(system, p)
            plain = score_cells(problem, kept_cell, kept, candidates.size)
            score, filtered_cell, filtered = filter_row(problem, kept_cell, kept, constants, field)
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


@njit(nogil=True, cache=True, inline="always")
def score_cells(
    problem: Problem, cell: NDArray[np.int32], weight: NDArray[np.float32], candidates: int
) -> float:
    """Minus twice the log-likelihood of a row of k cells out of s candidates, plus the penalty ``2 k ln s``.

    The first term is ``n ln(|f - A t|^2 / n)``, the mean square being at least the noise's variance.
    """
    matrix = np.empty((cell.size, problem.target.size), np.float32)
    stack_rows(problem.light, cell, problem.scale, matrix)
    residual = problem.target.copy()
    for j in range(cell.size):
        subtract(residual, weight[j], matrix[j])
    n = inner(problem.scale, problem.scale)
    score: float = n * math.log(max(inner(residual, residual) / n, problem.variance))
    score += 2 * math.log(max(candidates, 2)) * cell.size
    return score


@njit(nogil=True, cache=True, inline="always")
def filter_row(
    problem: Problem,
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    constants: Constants,
    field: NDArray[np.float32],
) -> tuple[float, NDArray[np.int32], NDArray[np.float32]]:
    """Filter a row of T by oriented Gaussians, fitted to its clusters iteratively.

    Parameters
    ----------
    problem : Problem
    cell, weight : (s,) int32, float32
        The row to start from, with positive weights, s at least 1.
    constants : Constants
    field : (clusters, rows, columns) float32
        Working space, all zero before and after.

    Returns
    -------
    score : float
        Minus twice the log-likelihood of the best Gaussians, plus 2 for each of their parameters.
    cell, weight : (s,) int32, float32
        The filtered row.

    Notes
    -----
    With m the Gaussians' mass on each cell, of sum 1, the prior is ``T ~ N(m, k diag m)`` (eq. 9): only cells inside
    a Gaussian can have weight, with a prior variance in proportion to their mass. Given the measurements f = A t of
    variance v, the posterior mean is ``t = m + M A' (A M A' + v / k)^-1 (f - A m)``, M = diag m, cut off at 0. The
    most likely k satisfies ``|f - A m|^2 = n (v + k)``, since the n rows of A are +-1. The next Gaussians have the
    moments of this t.

    Clusters are found by Ward's method, first as many as are allowed, then one fewer each time. The best number is
    kept.
    """
    moments = np.zeros((cell.size, PARAMETERS))
    for j in range(cell.size):
        add_moments(moments[j], cell[j], problem.columns, weight[j])
    best_score, best_cell, best_weight = np.inf, cell, weight
    count, most = cell.size, constants.clusters
    while True:
        count = merge_clusters(moments, count, most)
        score, inside, t = fit_gaussians(problem, moments[:count].copy(), cell, weight, constants, field)
        if score < best_score:
            best_score, best_cell, best_weight = score, inside, t
        if count == 1:
            break
        most = count - 1
    return best_score, best_cell, best_weight


@njit(nogil=True, cache=True, inline="always")
def fit_gaussians(
    problem: Problem,
    gaussians: NDArray[np.float64],
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    constants: Constants,
    field: NDArray[np.float32],
) -> tuple[float, NDArray[np.int32], NDArray[np.float32]]:
    """Filter a row by Gaussians of given moments (count, 6), fit them to the result, and repeat; return the best row.

    `gaussians` is overwritten. If no cell is inside a Gaussian, the score is infinite and the given row is returned.
    """
    best_score, best_cell, best_weight = np.inf, cell, weight
    n = inner(problem.scale, problem.scale)
    count, before = len(gaussians), np.inf
    for _ in range(constants.fits):
        inside, mass = integrate_gaussians(gaussians[:count], problem.columns, constants.reach, field)
        if inside.size == 0:
            break
        matrix = np.empty((inside.size, problem.target.size), np.float32)
        stack_rows(problem.light, inside, problem.scale, matrix)
        mean = np.zeros(inside.size, np.float32)
        for i in range(count):
            for j in range(inside.size):
                mean[j] += mass[i, j]
        residual = problem.target.copy()
        for j in range(inside.size):
            subtract(residual, mean[j], matrix[j])
        misfit = inner(residual, residual)
        prior_scale = max(misfit / n - problem.variance, 0.0)
        t = posterior_mean(
            matrix, residual, mean, problem.variance, prior_scale, constants.steps, constants.precision
        )
        score = n * math.log(max(misfit / n, problem.variance)) + 2 * PARAMETERS * count
        if score < best_score:
            best_score, best_cell, best_weight = score, inside, t
        if misfit >= (1 - constants.stall) * before:
            break
        before = misfit
        count = update_moments(inside, t, mean, mass, problem.columns, gaussians, count)
    return best_score, best_cell, best_weight


@njit(nogil=True, cache=True, inline="always")
def update_moments(
    cell: NDArray[np.int32],
    t: NDArray[np.float32],
    mean: NDArray[np.float32],
    mass: NDArray[np.float32],
    columns: int,
    gaussians: NDArray[np.float64],
    count: int,
) -> int:
    """Write the moments of t, shared among the Gaussians by their mass; return the number that are not empty."""
    kept = 0
    for i in range(count):
        for k in range(PARAMETERS):
            gaussians[kept, k] = 0
        for j in range(cell.size):
            if mass[i, j] > 0:
                add_moments(gaussians[kept], cell[j], columns, t[j] * mass[i, j] / mean[j])
        kept += gaussians[kept, 0] > LEAST_MASS
    return kept
