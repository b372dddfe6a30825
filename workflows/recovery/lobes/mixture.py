"""T as a mixture of oriented Gaussian lobes, fitted to the measurements of one pixel after another.

The measurements y of a pixel come in groups, one for each channel that a T serves (one also for the mean of channels
that saw the same patterns). A group is its m patterns in +-1 form, a black monitor and a white one. The model is
``y = offset + sum_k w_k D_k``, D_k what a lobe would see alone: the lobes need not add up to 1, for black and white say
how much there is, and the offset of each group is free.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import NODES, PARAMETERS, Shown, combine, fit_level, load, sample
from workflows.recovery.lobes.likelihood import price, weigh
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.pyramid import Grids
from workflows.recovery.solvers import inner

# Levenberg-Marquardt: the damping at the start, its factors after a step that failed or that did not, and most tries.
_DAMPING, _HARDER, _EASIER, _TRIES = 1e-2, 8.0, 0.15, 4
_LEAST_WEIGHT, _MOST_WEIGHT = 1e-3, 1.2


class Mixture(NamedTuple):
    """The lobes of a T, as many as there is room for, and the offsets.

    Attributes
    ----------
    lobes : (n, 6) float64
    level : (n,) int64
        The levels that they lie on.
    offset : (groups or more,) float64
    """

    lobes: NDArray[np.float64]
    level: NDArray[np.int64]
    offset: NDArray[np.float64]


class Room(NamedTuple):
    """Working space of :func:`predict`; t is 1, or 6 to have derivatives.

    Attributes
    ----------
    node : (NODES,) int64
    terms : (t, NODES) float32
    light : (NODES, groups * m) float32
    sums : (t, groups * m) float32
    """

    node: NDArray[np.int64]
    terms: NDArray[np.float32]
    light: NDArray[np.float32]
    sums: NDArray[np.float32]


@njit(nogil=True, cache=True)
def predict(
    shown: Shown,
    mixture: Mixture,
    k: int,
    room: Room,
    response: NDArray[np.float32],
    f: NDArray[np.float32],
) -> None:
    """Predict the measurements of a pixel.

    Parameters
    ----------
    shown : Shown
    mixture : Mixture
    k : int
        Its lobes.
    room : Room
    response : (k or more, t or more, groups (m + 2)) float32
        Written: D_k and its derivatives.
    f : (groups (m + 2),) float32
        Written: the prediction.
    """
    node, terms, light, sums = room
    first = np.int64(0)  # a literal would have `load` compiled once more
    groups, m = shown.groups, shown.m
    for g in range(groups):
        for j in range(g * (m + 2), (g + 1) * (m + 2)):
            f[j] = mixture.offset[g]
    for i in range(k):
        n = sample(mixture.lobes[i], mixture.level[i], shown.grids, node, terms)
        load(shown.code, shown.first, light.shape[1], node, n, light, first)
        combine(terms, light, n, sums)
        for t in range(terms.shape[0]):
            of_lobe = response[i, t]
            for g in range(groups):
                to = g * (m + 2)
                for j in range(m):
                    of_lobe[to + j] = sums[t, g * m + j]
                of_lobe[to + m] = -1.0 if t == 0 else 0.0
                of_lobe[to + m + 1] = 1.0 if t == 0 else 0.0
        weight, of_lobe = np.float32(mixture.lobes[i, 0]), response[i, 0]
        for j in range(f.size):
            f[j] += weight * of_lobe[j]


@njit(nogil=True, cache=True)
def copy_mixture(k: int, groups: int, mixture: Mixture, to: Mixture) -> None:
    """Copy the first k lobes and the offsets; loops compile sooner than slices."""
    for i in range(k):
        to.level[i] = mixture.level[i]
        for t in range(PARAMETERS):
            to.lobes[i, t] = mixture.lobes[i, t]
    for g in range(groups):
        to.offset[g] = mixture.offset[g]


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
def step(mixture: Mixture, change: NDArray[np.float64], grids: Grids, resolution: float) -> None:
    """Change the lobes by what was solved for, in bounds that keep them lobes and near the monitor."""
    lobes, level, columns, rows = mixture.lobes, mixture.level, grids.columns, grids.rows
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


class Equations(NamedTuple):
    """Working space of Levenberg-Marquardt steps for n parameters: one offset per group, then those of each lobe.

    Attributes
    ----------
    residual : (groups (m + 2),) float32
        Measurements less prediction, times the root of the precision.
    slopes : (n, groups (m + 2)) float32
        Derivatives of the prediction, times the root of the precision.
    A : (n, n) float64
        Lower triangle of ``slopes slopes'``.
    b, change : (n,) float64
        ``slopes residual``, and the solution.
    damped : (n, n) float64
    """

    residual: NDArray[np.float32]
    slopes: NDArray[np.float32]
    A: NDArray[np.float64]
    b: NDArray[np.float64]
    change: NDArray[np.float64]
    damped: NDArray[np.float64]


@njit(nogil=True, cache=True, inline="always")
def linearise(
    mixture: Mixture,
    k: int,
    groups: int,
    response: NDArray[np.float32],
    precision: NDArray[np.float32],
    equations: Equations,
) -> None:
    """Write the slopes about k lobes, and the normal equations ``A change = b``."""
    slopes, residual, A, b = equations.slopes, equations.residual, equations.A, equations.b
    size = precision.size // groups
    for g in range(groups):
        for j in range(precision.size):
            inside = g * size <= j < (g + 1) * size
            slopes[g, j] = math.sqrt(precision[j]) if inside else 0.0
    for i in range(k):
        for t in range(PARAMETERS):
            weight = np.float32(1.0 if t == 0 else mixture.lobes[i, 0])
            slope, of_lobe = slopes[groups + PARAMETERS * i + t], response[i, t]
            for j in range(precision.size):
                slope[j] = weight * of_lobe[j] * math.sqrt(precision[j])
    for i in range(b.size):
        b[i] = inner(slopes[i], residual)
        for j in range(i + 1):
            A[i, j] = inner(slopes[i], slopes[j])


@njit(nogil=True, cache=True, inline="always")
def solve_damped(equations: Equations, damping: float) -> bool:
    """Write the change that solves the damped equations; false if there is none."""
    A, damped, change = equations.A, equations.damped, equations.change
    for i in range(change.size):
        change[i] = equations.b[i]
        for j in range(i + 1):
            damped[i, j] = A[i, j]
        damped[i, i] += damping * A[i, i] + 1e-6
    solved: bool = solve(damped, change)
    return solved


@njit(nogil=True, cache=True, inline="always")
def refine_round(
    shown: Shown,
    y: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    options: LobesOptions,
    room: Room,
    response: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    equations: Equations,
    new: Mixture,
) -> None:
    """Take Levenberg-Marquardt steps at fixed precisions; `mixture`, `response` and `f` are changed together."""
    damping = _DAMPING
    chi = misfit(y, f, precision, equations.residual)
    for _ in range(options.steps):
        linearise(mixture, k, shown.groups, response, precision, equations)
        better, now = False, chi
        for _ in range(_TRIES):
            if solve_damped(equations, damping):
                copy_mixture(k, shown.groups, mixture, new)
                for g in range(shown.groups):
                    new.offset[g] += equations.change[g]
                step(new, equations.change[shown.groups :], shown.grids, options.fit_resolution)
                predict(shown, new, k, room, response, f)
                now = misfit(y, f, precision, equations.residual)
                better = now < chi
                if better:
                    break
            damping *= _HARDER
        if not better:
            predict(shown, mixture, k, room, response, f)
            break
        damping = max(damping * _EASIER, 1e-5)
        copy_mixture(k, shown.groups, new, mixture)
        if chi - now < options.tolerance:
            break
        chi = now


@njit(nogil=True, cache=True)
def refine(
    shown: Shown,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    options: LobesOptions,
    bound: float,
) -> tuple[float, float, NDArray[np.float32], NDArray[np.float32]]:
    """Fit all parameters of k lobes by the Levenberg-Marquardt method, starting from their present values.

    Parameters
    ----------
    shown : Shown
    y, variance : (groups (m + 2),) float32
        As in :func:`~workflows.recovery.lobes.likelihood.weigh`.
    mixture : Mixture
        Changed.
    k : int
    options : LobesOptions
        `fit_resolution`, `rounds`, `steps` and `tolerance` are used.
    bound : float
        Rounds end once the objective plus the price is above it.

    Returns
    -------
    kappa, objective : float
        As from :func:`~workflows.recovery.lobes.likelihood.weigh`.
    f, precision : like y
    """
    groups, size = shown.groups, shown.groups * shown.m
    M, n = y.size, groups + PARAMETERS * k
    room = Room(
        np.empty(NODES, np.int64),
        np.empty((PARAMETERS, NODES), np.float32),
        np.empty((NODES, size), np.float32),
        np.empty((PARAMETERS, size), np.float32),
    )
    response = np.empty((k, PARAMETERS, M), np.float32)
    f, precision = np.empty_like(y), np.empty_like(y)
    equations = Equations(
        np.empty_like(y),
        np.empty((n, M), np.float32),
        np.empty((n, n)),
        np.empty(n),
        np.empty(n),
        np.empty((n, n)),
    )
    new = Mixture(mixture.lobes.copy(), mixture.level.copy(), mixture.offset.copy())
    predict(shown, mixture, k, room, response, f)
    kappa, objective = weigh(y, f, variance, groups, n, precision)
    for _ in range(options.rounds):
        before = objective
        refine_round(shown, y, mixture, k, options, room, response, f, precision, equations, new)
        kappa, objective = weigh(y, f, variance, groups, n, precision)
        if abs(before - objective) < 1 or objective + price(shown.grids, mixture.level, k) > bound:
            break
    return kappa, objective, f, precision
