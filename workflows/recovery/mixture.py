"""T as a mixture of oriented Gaussian lobes, fitted to the measurements of one pixel after another.

The measurements y of a pixel come in groups, one for each channel that a T serves (one also for the mean of channels
that saw the same patterns). A group is its m patterns in +-1 form, a black monitor and a white one. The model is
``y = offset + sum_k w_k D_k``, D_k what a lobe would see alone: the lobes need not add up to 1, for black and white say
how much there is, and the offset of each group is free.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.footprint import NODES, PARAMETERS, combine, fit_level, load, sample
from workflows.recovery.solvers import inner

# A pattern's contrast within T is never quite zero.
_LEAST_CONTRAST = 0.02
# Levenberg-Marquardt: the damping at the start, its factors after a step that failed or that did not, and most tries.
_DAMPING, _HARDER, _EASIER, _TRIES = 1e-2, 8.0, 0.15, 4
_LEAST_WEIGHT, _MOST_WEIGHT = 1e-3, 1.2


@njit(nogil=True, cache=True)
def predict(
    code: NDArray[np.uint8],
    first: int,
    groups: int,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    lobes: NDArray[np.float64],
    level: NDArray[np.int64],
    k: int,
    offset: NDArray[np.float64],
    node: NDArray[np.int64],
    terms: NDArray[np.float32],
    light: NDArray[np.float32],
    sums: NDArray[np.float32],
    response: NDArray[np.float32],
    f: NDArray[np.float32],
) -> None:
    """Predict the measurements of a pixel.

    Parameters
    ----------
    code : (nodes, m * groups or more) uint8
    first, groups : int
        The first column of `code`, and the number of groups after it.
    columns, rows, starts
        Of the pyramid.
    lobes : (k or more, 6) float64
    level : (k or more,) int64
    k : int
    offset : (groups,) float64
    node, terms, light, sums
        Working space: (NODES,), (t, NODES), (NODES, groups m), (t, groups m); t is 1, or 6 to have derivatives.
    response : (k or more, t or more, groups (m + 2)) float32
        Written: D_k and its derivatives.
    f : (groups (m + 2),) float32
        Written: the prediction.
    """
    m = light.shape[1] // groups
    for g in range(groups):
        for j in range(g * (m + 2), (g + 1) * (m + 2)):
            f[j] = offset[g]
    for i in range(k):
        n = sample(lobes[i], level[i], columns, rows, starts, node, terms)
        load(code, first, light.shape[1], node, n, light, 0)
        combine(terms, light, n, sums)
        for t in range(terms.shape[0]):
            of_lobe = response[i, t]
            for g in range(groups):
                to = g * (m + 2)
                for j in range(m):
                    of_lobe[to + j] = sums[t, g * m + j]
                of_lobe[to + m] = -1.0 if t == 0 else 0.0
                of_lobe[to + m + 1] = 1.0 if t == 0 else 0.0
        weight, of_lobe = np.float32(lobes[i, 0]), response[i, 0]
        for j in range(f.size):
            f[j] += weight * of_lobe[j]


@njit(nogil=True, cache=True)
def copy_lobes(
    k: int,
    lobes: NDArray[np.float64],
    level: NDArray[np.int64],
    to: NDArray[np.float64],
    to_level: NDArray[np.int64],
) -> None:
    """Copy the first k lobes and their levels; loops compile sooner than slices."""
    for i in range(k):
        to_level[i] = level[i]
        for t in range(PARAMETERS):
            to[i, t] = lobes[i, t]


@njit(nogil=True, cache=True)
def scatter(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    parameters: int,
    least: float,
) -> tuple[float, float]:
    """How far T is from what predicts the measurements.

    Parameters
    ----------
    y, f, variance : (groups (m + 2),) float32
        Measurements, prediction, and the camera's share of their variances; infinite for no measurement.
    mean : like y
        What the prediction makes of the patterns, without offsets.
    groups, parameters : int
        Parameters that were fitted.
    least : float
        The least kappa.

    Returns
    -------
    kappa : float
        Variance that a pattern of full contrast has because T is not the prediction's; 1 if T is a single ray.
    misfit : float
        By how much the squared residuals of the patterns are larger than their variances, in the mean.

    Notes
    -----
    A T of mean t and covariance kappa diag(t) adds the variance kappa (1 - mean^2) to a pattern of +-1. kappa is
    found by a few scoring steps from its moment estimate.
    """
    m = y.size // groups - 2
    kappa, misfit, freedom = 0.0, 0.0, 1.0
    for scoring in range(5):
        excess, contrast, used = 0.0, 1e-9, 0
        for g in range(groups):
            for j in range(g * (m + 2), g * (m + 2) + m):
                if variance[j] < np.inf:
                    share = max(1 - mean[j] * mean[j], _LEAST_CONTRAST)
                    weight = share / (variance[j] + kappa * share) ** 2 if scoring > 0 else 1.0
                    excess += weight * (freedom * (y[j] - f[j]) ** 2 - variance[j])
                    contrast += weight * share
                    used += 1
        kappa = min(max(excess / contrast, least), 1.0)
        if scoring == 0:
            misfit = excess / max(used, 1)
            freedom = used / max(used - parameters, used / 4, 1)
    return kappa, misfit


@njit(nogil=True, cache=True)
def weigh(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    parameters: int,
    precision: NDArray[np.float32],
) -> tuple[float, float]:
    """The precision of measurements whose prediction leaves some of T out.

    Parameters
    ----------
    y, f, variance : (groups (m + 2),) float32
        Measurements, prediction, and the camera's share of their variances; infinite for no measurement.
    groups, parameters : int
        Parameters that were fitted.
    precision : like y
        Written.

    Returns
    -------
    kappa : float
        As from :func:`scatter`.
    objective : float
        -2 ln likelihood, up to a constant.
    """
    m = y.size // groups - 2
    kappa, _ = scatter(y, f, f, variance, groups, parameters, 0.0)
    objective = 0.0
    for g in range(groups):
        for j in range(g * (m + 2), (g + 1) * (m + 2)):
            share = max(1 - f[j] * f[j], _LEAST_CONTRAST) if j < g * (m + 2) + m else 0.0
            total = variance[j] + kappa * share
            precision[j] = 1 / total
            if total < np.inf:
                objective += (y[j] - f[j]) ** 2 / total + math.log(total)
    return kappa, objective


@njit(nogil=True, cache=True)
def price(columns: NDArray[np.int64], rows: NDArray[np.int64], level: NDArray[np.int64], k: int) -> float:
    """What k lobes must be worth in -2 ln likelihood: 2 for each shape and weight, and their places among all."""
    cost = 0.0
    for i in range(k):
        cost += 2 * (PARAMETERS - 2) + 2 * math.log(columns[level[i]] * rows[level[i]])
    return cost


@njit(nogil=True, cache=True)
def solve(A: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Solve A x = b in place by Cholesky's decomposition; false if A is not positive definite."""
    n = b.size
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            if i > j:
                A[i, j] = s / A[j, j]
            elif s > 1e-30:
                A[i, i] = math.sqrt(s)
            else:
                return False
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]
    return True


@njit(nogil=True, cache=True)
def step(
    lobes: NDArray[np.float64],
    level: NDArray[np.int64],
    change: NDArray[np.float64],
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    resolution: float,
) -> None:
    """Change the lobes by what was solved for, in bounds that keep them lobes and near the monitor."""
    for i in range(change.size // PARAMETERS):
        lobe, by = lobes[i], change[PARAMETERS * i : PARAMETERS * (i + 1)]
        spacing = 2.0 ** level[i]
        size = max(lobe[3], lobe[5], abs(lobe[4]))
        far = 2 * size + spacing
        lobe[0] = min(max(lobe[0] + by[0], _LEAST_WEIGHT), _MOST_WEIGHT)
        lobe[1] = min(max(lobe[1] + min(max(by[1], -far), far), -20.0), columns[0] + 20.0)
        lobe[2] = min(max(lobe[2] + min(max(by[2], -far), far), -20.0), rows[0] + 20.0)
        lobe[3] = max(min(max(lobe[3] + by[3], lobe[3] / 2), 2 * lobe[3]), 0.4 * spacing)
        lobe[4] += min(max(by[4], -size), size)
        lobe[5] = max(min(max(lobe[5] + by[5], lobe[5] / 2), 2 * lobe[5]), 0.4 * spacing)
        level[i] = fit_level(lobe, level[i], columns, resolution)


@njit(nogil=True, cache=True)
def misfit(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> float:
    """The sum of squared residuals by their precisions; the weighted residuals are written."""
    for j in range(y.size):
        residual[j] = (y[j] - f[j]) * math.sqrt(precision[j])
    return float(inner(residual, residual))


@njit(nogil=True, cache=True)
def refine(
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
    resolution: float,
    rounds: int,
    steps: int,
    tolerance: float,
    bound: float,
) -> tuple[float, float, NDArray[np.float32], NDArray[np.float32]]:
    """Fit all parameters of k lobes by Levenberg and Marquardt's method, from what they are.

    Parameters
    ----------
    code, first, groups, columns, rows, starts
        As in :func:`predict`.
    y, variance : (groups (m + 2),) float32
        As in :func:`weigh`.
    lobes, level, offset
        Changed.
    k : int
    resolution : float
        As in :func:`~workflows.recovery.footprint.fit_level`.
    rounds, steps : int
        Most rounds, after each of which the measurements are weighed again, and most steps in one.
    tolerance : float
        A round ends when a step takes less than this off chi-square.
    bound : float
        Rounds end when the objective and the price are above it.

    Returns
    -------
    kappa, objective : float
        As from :func:`weigh`.
    f, precision : like y
    """
    M, n = y.size, groups + PARAMETERS * k
    m = M // groups - 2
    node = np.empty(NODES, np.int64)
    terms = np.empty((PARAMETERS, NODES), np.float32)
    light = np.empty((NODES, groups * m), np.float32)
    sums = np.empty((PARAMETERS, groups * m), np.float32)
    response = np.empty((k, PARAMETERS, M), np.float32)
    f, precision, residual = np.empty_like(y), np.empty_like(y), np.empty_like(y)
    slopes, A, damped = np.empty((n, M), np.float32), np.empty((n, n)), np.empty((n, n))
    b, change = np.empty(n), np.empty(n)
    new_lobes, new_level, new_offset = lobes.copy(), level.copy(), offset.copy()
    predict(
        code,
        first,
        groups,
        columns,
        rows,
        starts,
        lobes,
        level,
        k,
        offset,
        node,
        terms,
        light,
        sums,
        response,
        f,
    )
    kappa, objective = weigh(y, f, variance, groups, n, precision)
    for _ in range(rounds):
        before = objective
        damping = _DAMPING
        chi = misfit(y, f, precision, residual)
        for _ in range(steps):
            for g in range(groups):
                for j in range(M):
                    inside = g * (m + 2) <= j < (g + 1) * (m + 2)
                    slopes[g, j] = math.sqrt(precision[j]) if inside else 0.0
            for i in range(k):
                for t in range(PARAMETERS):
                    weight = np.float32(1.0 if t == 0 else lobes[i, 0])
                    slope, of_lobe = slopes[groups + PARAMETERS * i + t], response[i, t]
                    for j in range(M):
                        slope[j] = weight * of_lobe[j] * math.sqrt(precision[j])
            for i in range(n):
                b[i] = inner(slopes[i], residual)
                for j in range(i + 1):
                    A[i, j] = inner(slopes[i], slopes[j])
            better = False
            now = chi
            for _ in range(_TRIES):
                for i in range(n):
                    change[i] = b[i]
                    for j in range(i + 1):
                        damped[i, j] = A[i, j]
                    damped[i, i] += damping * A[i, i] + 1e-6
                if solve(damped, change):
                    copy_lobes(k, lobes, level, new_lobes, new_level)
                    for g in range(groups):
                        new_offset[g] = offset[g] + change[g]
                    step(new_lobes, new_level, change[groups:], columns, rows, resolution)
                    predict(
                        code, first, groups, columns, rows, starts, new_lobes, new_level, k, new_offset,
                        node, terms, light, sums, response, f,
                    )  # fmt: skip
                    now = misfit(y, f, precision, residual)
                    better = now < chi
                    if better:
                        break
                damping *= _HARDER
            if not better:
                predict(
                    code, first, groups, columns, rows, starts, lobes, level, k, offset,
                    node, terms, light, sums, response, f,
                )  # fmt: skip
                break
            damping = max(damping * _EASIER, 1e-5)
            copy_lobes(k, new_lobes, new_level, lobes, level)
            for g in range(groups):
                offset[g] = new_offset[g]
            if chi - now < tolerance:
                break
            chi = now
        kappa, objective = weigh(y, f, variance, groups, n, precision)
        if abs(before - objective) < 1 or objective + price(columns, rows, level, k) > bound:
            break
    return kappa, objective, f, precision
