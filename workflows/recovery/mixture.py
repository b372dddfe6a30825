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
# Rounds of a further lobe go on while it is no worse than this behind in -2 ln likelihood.
_HOPE = 30.0
_NEVER = 1e30


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


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def score(
    row: NDArray[np.uint8],
    f: NDArray[np.float32],
    residual: NDArray[np.float32],
    precision: NDArray[np.float32],
) -> tuple[float, float]:
    """What moving light from the prediction to a node would gain.

    Parameters
    ----------
    row : (groups m,) uint8
        Codes of the node.
    f, residual, precision : (groups m,) float32
        Of the patterns: the prediction as a code, what is left over times its precision, and precision, both for a
        code's unit.

    Returns
    -------
    z : float
        In standard deviations.
    amount : float
        Of light.

    Notes
    -----
    ``z = sum d r / v / sqrt(sum d^2 / v)``, d the node's row less the prediction.
    """
    along, across = np.float32(0), np.float32(1e-9)
    for j in range(row.size):
        d = np.float32(row[j]) - f[j]
        along += d * residual[j]
        across += d * d * precision[j]
    return float(along / math.sqrt(across)), float(along / across)


@njit(nogil=True, cache=True)
def search(
    code: NDArray[np.uint8],
    first: int,
    groups: int,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    beam: int,
) -> tuple[int, int, int, float, float]:
    """Find the node where more light would explain most, from the coarsest grid to ever finer ones.

    Parameters
    ----------
    code, first, groups, columns, rows, starts
        As in :func:`predict`.
    y, f, precision : (groups (m + 2),) float32
    beam : int
        Nodes of a grid whose children are looked at.

    Returns
    -------
    level, column, row : int
        Level -1 if there is none.
    gain : float
        In -2 ln likelihood, less what a place among the nodes of its level costs.
    amount : float
        Of light.
    """
    m = y.size // groups - 2
    size = groups * m
    codes_of_f, residual, weight = (
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
    )
    unit = np.float32(2 / 255)
    for g in range(groups):
        for j in range(m):
            at = g * (m + 2) + j
            codes_of_f[g * m + j] = (f[at] + 1) / unit
            residual[g * m + j] = unit * (y[at] - f[at]) * precision[at]
            weight[g * m + j] = unit**2 * precision[at]
    best_level, best_column, best_row, gain, amount, best_z = -1, 0, 0, -_NEVER, 0.0, 0.0
    parents, z_of = np.empty((beam, 2), np.int64), np.empty(beam)
    children = np.empty((beam, 2), np.int64)
    count = 0
    for level in range(columns.size - 1, -1, -1):
        wide, high = columns[level], rows[level]
        whole = level == columns.size - 1
        place = 2 * math.log(wide * high)
        found, z_found = 0, -_NEVER
        for p in range(wide * high if whole else 4 * count):
            if whole:
                column, row = p % wide, p // wide
            else:
                column, row = 2 * parents[p // 4, 0] + p % 2, 2 * parents[p // 4, 1] + p % 4 // 2
            if column >= wide or row >= high:
                continue
            codes = code[starts[level] + row * wide + column, first : first + size]
            z, much = score(codes, codes_of_f, residual, weight)
            z_found = max(z_found, z)
            if z > 0 and z * z - place > gain:
                best_level, best_column, best_row, gain, amount, best_z = (
                    level,
                    column,
                    row,
                    z * z - place,
                    much,
                    z,
                )
            if found < beam or z > z_of[found - 1]:
                at = min(found, beam - 1)
                found = at + 1
                while at > 0 and z_of[at - 1] < z:
                    z_of[at] = z_of[at - 1]
                    children[at, 0], children[at, 1] = children[at - 1, 0], children[at - 1, 1]
                    at -= 1
                z_of[at] = z
                children[at, 0], children[at, 1] = column, row
        if z_found < 0.7 * best_z:
            break
        count = found
        parents, children = children, parents
    return best_level, best_column, best_row, gain, amount


@njit(nogil=True, cache=True)
def fit(
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
    most: int,
    resolution: float,
    rounds: int,
    steps: int,
    tolerance: float,
    beam: int,
) -> tuple[int, float, float]:
    """Fit as many lobes to a pixel as pay for themselves.

    Parameters
    ----------
    code, first, groups, columns, rows, starts, y, variance
        As in :func:`refine`.
    lobes, level, offset
        The first k lobes are the start; changed. There is room for `most` lobes.
    k, most : int
        Lobes at the start, and at the end at most.
    resolution, rounds, steps, tolerance
        As in :func:`refine`.
    beam : int
        As in :func:`search`.

    Returns
    -------
    k : int
        Lobes; one at least.
    kappa, objective : float
        As from :func:`weigh`.
    """
    m = y.size // groups - 2
    f, precision = np.zeros_like(y), np.empty_like(y)
    for g in range(groups):
        # light from everywhere: of a pattern its mean, about nothing
        f[g * (m + 2) + m], f[g * (m + 2) + m + 1] = -1.0, 1.0
    if k > 0:
        kappa, objective, f, precision = refine(
            code, first, groups, columns, rows, starts, y, variance, lobes, level, k, offset,
            resolution, rounds, steps, tolerance, _NEVER,
        )  # fmt: skip
        objective += price(columns, rows, level, k)
    else:
        kappa, objective = weigh(y, f, variance, groups, groups, precision)
        objective = _NEVER
    tried, tried_level, tried_offset = lobes.copy(), level.copy(), offset.copy()
    while k < most:
        at, column, row, gain, amount = search(
            code, first, groups, columns, rows, starts, y, f, precision, beam
        )
        if k > 0 and gain < 2 * (PARAMETERS - 2):
            break
        if at < 0:  # nothing says anything: light from everywhere
            at, column, row = columns.size - 1, columns[-1] // 2, rows[-1] // 2
        copy_lobes(k, lobes, level, tried, tried_level)
        for g in range(groups):
            tried_offset[g] = offset[g]
        spacing = 2.0**at
        share = min(max(amount, 0.02), 1.0) if k > 0 else 1.0
        for i in range(k):
            tried[i, 0] *= 1 - share
        tried[k, 0], tried[k, 1], tried[k, 2] = share, (column + 0.5) * spacing, (row + 0.5) * spacing
        tried[k, 3], tried[k, 4], tried[k, 5] = 0.8 * spacing, 0.0, 0.8 * spacing
        tried_level[k] = fit_level(tried[k], at, columns, resolution)
        new_kappa, new, new_f, new_precision = refine(
            code, first, groups, columns, rows, starts, y, variance, tried, tried_level, k + 1, tried_offset,
            resolution, rounds, steps, tolerance, objective + _HOPE,
        )  # fmt: skip
        new += price(columns, rows, tried_level, k + 1)
        if new >= objective:
            break
        k += 1
        kappa, objective, f, precision = new_kappa, new, new_f, new_precision
        copy_lobes(k, tried, tried_level, lobes, level)
        for g in range(groups):
            offset[g] = tried_offset[g]
    return k, kappa, objective - price(columns, rows, level, k)
