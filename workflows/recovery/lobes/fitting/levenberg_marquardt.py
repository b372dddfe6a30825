"""The Levenberg-Marquardt fit of all parameters of a mixture to the measurements of a pixel."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import PARAMETERS, PatternCodes, fit_level
from workflows.recovery.lobes.likelihood import penalty, weigh
from workflows.recovery.lobes.mixture import (
    RATES,
    Mixture,
    Workspace,
    clone,
    copy_mixture,
    predict,
    without_derivatives,
)
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.lobes.strays import STRAY
from workflows.recovery.pyramid import Grids
from workflows.recovery.solvers import inner

# Initial damping, its factors after a failed and a successful step, and the most attempts per step.
_DAMPING, _INCREASE, _DECREASE, _ATTEMPTS = 1e-2, 8.0, 0.15, 4
# Standard deviation of the dispersion along an axis, in cells, before anything is known of it.
_DISPERSION = 30.0
# Bounds of a lobe's weight.
_LEAST_WEIGHT, _MOST_WEIGHT = 1e-3, 1.2


@njit(nogil=True, cache=True)
def solve(A: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Solve A x = b in place by Cholesky decomposition; return false if A is not positive definite."""
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
def apply_step(mixture: Mixture, change: NDArray[np.float64], grids: Grids, resolution: float) -> None:
    """Add a solved step to the lobes, limited so that they stay well-shaped and near the monitor."""
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


@njit(nogil=True, cache=True, inline="always")
def axes_of(patterns: PatternCodes) -> int:
    """Along how many axes lobes may lie apart in red, green and blue: the parameters of the dispersion."""
    return 2 if patterns.dispersed else 0


@njit(nogil=True, cache=True, inline="always")
def disperse(mixture: Mixture, change: NDArray[np.float64]) -> None:
    """Add a solved step to the dispersion, limited as that of the first lobe's centre is."""
    lobe = mixture.lobes[0]
    far = 2 * max(lobe[3], lobe[5], abs(lobe[4])) + 2.0 ** mixture.level[0]
    for axis in range(2):
        mixture.dispersion[axis] += min(max(change[axis], -far), far)


@njit(nogil=True, cache=True)
def chi_square(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    root: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> float:
    """Return chi-square, the sum of squared residuals times their precisions; write the weighted residuals."""
    for j in range(y.size):
        residual[j] = (y[j] - f[j]) * root[j]
    return float(inner(residual, residual))


class Equations(NamedTuple):
    """Working space of the steps for n parameters: stray light of each group, a dispersion where the
    patterns have one, then the parameters of each lobe.

    Attributes
    ----------
    root : (groups (m + 2),) float32
        Square root of the precision.
    residual : (groups (m + 2),) float32
        Measurements less prediction, times the square root of the precision.
    slopes : (n, groups (m + 2)) float32
        Derivatives of the prediction, times the square root of the precision.
    A : (n, n) float64
        Lower triangle of ``slopes slopes'``.
    b, change : (n,) float64
        ``slopes residual``, and the solution.
    damped : (n, n) float64
        A plus the damping, then its Cholesky factor.
    """

    root: NDArray[np.float32]
    residual: NDArray[np.float32]
    slopes: NDArray[np.float32]
    A: NDArray[np.float64]
    b: NDArray[np.float64]
    change: NDArray[np.float64]
    damped: NDArray[np.float64]


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def write_normal(
    slopes: NDArray[np.float32],
    residual: NDArray[np.float32],
    A: NDArray[np.float64],
    b: NDArray[np.float64],
) -> None:
    """Write the lower triangle of ``A = slopes slopes'`` and ``b = slopes residual``."""
    for i in range(b.size):
        along = np.float32(0)
        for j in range(residual.size):
            along += slopes[i, j] * residual[j]
        b[i] = along
        for k in range(i + 1):
            product = np.float32(0)
            for j in range(residual.size):
                product += slopes[i, j] * slopes[k, j]
            A[i, k] = product


@njit(nogil=True, cache=True, inline="always")
def linearise(
    patterns: PatternCodes,
    mixture: Mixture,
    k: int,
    response: NDArray[np.float32],
    equations: Equations,
) -> None:
    """Write the derivatives by stray light and k lobes, and the normal equations ``A change = b``."""
    root, residual, slopes, A, b, _, _ = equations
    strays, groups, lobes = patterns.strays, patterns.groups, mixture.lobes
    count, size = strays.shape
    for g in range(groups):
        for s in range(count):
            slope = slopes[g * count + s]
            slope[:] = 0
            for j in range(size):
                slope[g * size + j] = strays[s, j] * root[g * size + j]
    before = groups * count
    for axis in range(axes_of(patterns)):
        slope = slopes[before]
        slope[:] = 0
        for i in range(k):
            of_lobe = response[i, 1 + axis]
            for g in range(groups):
                weight = np.float32(RATES[g] * lobes[i, 0])
                for j in range(g * size, (g + 1) * size):
                    slope[j] += weight * of_lobe[j] * root[j]
        before += 1
    for i in range(k):
        for t in range(PARAMETERS):
            weight = np.float32(1.0 if t == 0 else lobes[i, 0])
            slope, of_lobe = slopes[before + PARAMETERS * i + t], response[i, t]
            for j in range(root.size):
                slope[j] = weight * of_lobe[j] * root[j]
    write_normal(slopes, residual, A, b)
    for i in range(groups * count):
        if i % count > 0:
            A[i, i] += 1 / STRAY**2
            b[i] -= mixture.stray[i] / STRAY**2
    for axis in range(axes_of(patterns)):
        i = groups * count + axis
        A[i, i] += 1 / _DISPERSION**2
        b[i] -= mixture.dispersion[axis] / _DISPERSION**2


@njit(nogil=True, cache=True, inline="always")
def solve_damped(equations: Equations, damping: float) -> bool:
    """Write the solution of the damped equations; return false if there is none."""
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
    patterns: PatternCodes,
    y: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    options: LobesOptions,
    workspace: Workspace,
    response: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    equations: Equations,
    new: Mixture,
    least: float,
) -> None:
    """Take Levenberg-Marquardt steps at fixed precisions; `mixture`, `response` and `f` are overwritten.

    The linear model expects a step to lower chi-square by about ``change b``. To try one takes longer than to solve it.
    """
    damping, strays = _DAMPING, patterns.groups * len(patterns.strays)
    lobes, root, residual = strays + axes_of(patterns), equations.root, equations.residual
    for j in range(root.size):
        root[j] = math.sqrt(precision[j])
    chi = chi_square(y, f, root, residual)
    for _ in range(options.steps):
        linearise(patterns, mixture, k, response, equations)
        better, new_chi, tried = False, chi, False
        for _ in range(_ATTEMPTS):
            if solve_damped(equations, damping):
                expected = 0.0
                for i in range(equations.b.size):
                    expected += equations.b[i] * equations.change[i]
                if expected < least:
                    break
                tried = True
                copy_mixture(k, strays, mixture, new)
                for s in range(strays):
                    new.stray[s] += equations.change[s]
                if patterns.dispersed:
                    disperse(new, equations.change[strays:lobes])
                apply_step(new, equations.change[lobes:], patterns.grids, options.fit_resolution)
                predict(patterns, new, k, workspace, response, f)
                new_chi = chi_square(y, f, root, residual)
                better = new_chi < chi
                if better:
                    break
            damping *= _INCREASE
        if not better:
            if tried:
                predict(patterns, mixture, k, workspace, response, f)
            break
        damping = max(damping * _DECREASE, 1e-5)
        copy_mixture(k, strays, new, mixture)
        if chi - new_chi < options.tolerance:
            break
        chi = new_chi


@njit(nogil=True, cache=True)
def fit_amounts(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    workspace: Workspace,
) -> None:
    """Fit the amounts of stray light and the weights of the lobes with the precisions that the fitted lobes leave.

    Those of the fit itself were known before the lobes were, when most of the patterns' light was unexplained.

    Parameters
    ----------
    patterns, y, variance
        As in :func:`refine`.
    mixture : Mixture
        Its stray light and weights are changed.
    k : int
    workspace : Workspace
    """
    strays, groups = patterns.strays, patterns.groups
    count, size = strays.shape
    f, precision, response = np.empty_like(y), np.empty_like(y), np.empty((k, 1, y.size), np.float32)
    predict(patterns, mixture, k, without_derivatives(workspace), response, f)
    n = groups * count + k
    weigh(y, f, variance, groups, n, precision)
    rows = np.zeros((n, y.size), np.float32)
    for i in range(groups * count):
        g = i // count
        rows[i, g * size : (g + 1) * size] = strays[i % count]
    for i in range(k):
        rows[groups * count + i] = response[i, 0]
    A, b, wanted = np.empty((n, n)), np.empty(n), y * precision
    for i in range(n):
        b[i] = inner(rows[i], wanted)
        weighted = rows[i] * precision
        for j in range(i + 1):
            A[i, j] = inner(weighted, rows[j])
        if i < groups * count and i % count > 0:
            A[i, i] += 1 / STRAY**2
    if solve(A, b) and (k == 0 or b[groups * count :].min() > 0):
        mixture.stray[: groups * count] = b[: groups * count]
        for i in range(k):
            mixture.lobes[i, 0] = b[groups * count + i]


@njit(nogil=True, cache=True)
def refine(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    options: LobesOptions,
    workspace: Workspace,
    least: float,
    bound: float,
) -> tuple[float, float, NDArray[np.float32], NDArray[np.float32]]:
    """Fit all parameters of k lobes by the Levenberg-Marquardt method, starting from their present values.

    Parameters
    ----------
    patterns : PatternCodes
    y, variance : (groups (m + 2),) float32
        As in :func:`~workflows.recovery.lobes.likelihood.weigh`.
    mixture : Mixture
        Changed in place.
    k : int
    options : LobesOptions
        `fit_resolution`, `rounds`, `steps` and `tolerance` are used.
    workspace : Workspace
    least : float
        A step is not tried if the linear model expects it to lower chi-square by less than this.
    bound : float
        Rounds end once the objective plus the penalty is above it.

    Returns
    -------
    kappa, objective : float
        As from :func:`~workflows.recovery.lobes.likelihood.weigh`.
    f, precision : (groups (m + 2),) float32
        Prediction and precisions.
    """
    groups = patterns.groups
    M, n = y.size, groups * len(patterns.strays) + axes_of(patterns) + PARAMETERS * k
    response = np.empty((k, PARAMETERS, M), np.float32)
    f, precision = np.empty_like(y), np.empty_like(y)
    equations = Equations(
        np.empty_like(y),
        np.empty_like(y),
        np.empty((n, M), np.float32),
        np.empty((n, n)),
        np.empty(n),
        np.empty(n),
        np.empty((n, n)),
    )
    new = clone(mixture)
    predict(patterns, mixture, k, workspace, response, f)
    kappa, objective = weigh(y, f, variance, groups, n, precision)
    for _ in range(options.rounds):
        before = objective
        refine_round(
            patterns, y, mixture, k, options, workspace, response, f, precision, equations, new, least
        )
        kappa, objective = weigh(y, f, variance, groups, n, precision)
        if abs(before - objective) < 1 or objective + penalty(patterns.grids, mixture.level, k) > bound:
            break
    return kappa, objective, f, precision
