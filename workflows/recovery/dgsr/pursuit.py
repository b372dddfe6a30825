"""Non-negative dynamic group sparsity (NN-DGSR): kernels that choose the cells of T's rows and fit their weights."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.dgsr.groups import Rows, group_sums
from workflows.recovery.dgsr.options import Constants
from workflows.recovery.solvers import inner, solve_nnls, stack_rows


class System(NamedTuple):
    """The measurements from which n rows of T on a level's grid are solved.

    Attributes
    ----------
    light : (channels, cells, m) float32
        Light of the level, 0 to 1.
    columns, rows : int
        The level's grid.
    source : (n,) int64
        First channel of `light` that a row's measurements belong to.
    scale, target : (n, c * m) float32
        Factors that give the measurements of a row equal variances, 0 for unusable ones; and the measurements of c
        channels in +-1 form, times these factors.
    variance : (n,) float64
        Variance of a row's scaled measurements.
    """

    light: NDArray[np.float32]
    columns: int
    rows: int
    source: NDArray[np.int64]
    scale: NDArray[np.float32]
    target: NDArray[np.float32]
    variance: NDArray[np.float64]


class Problem(NamedTuple):
    """The measurements from which one row of T is solved: a row of a `System`.

    Attributes
    ----------
    light : (c, cells, m) float32
        Light of the row's channels.
    columns : int
    scale, target : (c * m,) float32
    variance : float
    """

    light: NDArray[np.float32]
    columns: int
    scale: NDArray[np.float32]
    target: NDArray[np.float32]
    variance: float


@njit(nogil=True, cache=True, inline="always")
def problem_of(system: System, p: int) -> Problem:
    """Row p of a system."""
    channels = system.scale.shape[1] // system.light.shape[2]
    light = system.light[system.source[p] : system.source[p] + channels]
    return Problem(light, system.columns, system.scale[p], system.target[p], system.variance[p])


@njit(nogil=True, cache=True)
def grow_rows(system: System, rows: Rows, finest: bool, constants: Constants) -> None:
    """Fit the weights of sparse rows to measurements by NN-DGSR, from zero.

    Parameters
    ----------
    system : System
    rows : Rows
        Candidate cells; the weights are overwritten.
    finest : bool
        Whether this is the finest level, where cells that do not improve the fit enough are not added, or dropped.
    constants : Constants
    """
    begin, cell, weight = rows
    field = np.zeros((system.rows + 2, system.columns + 2), np.float32)
    for p in range(system.source.size):
        candidates, best = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        best[:] = 0
        problem = problem_of(system, p)
        m = inner(problem.scale, problem.scale)
        if candidates.size > 0 and m > 0:
            grow_row(problem, candidates, best, m, finest, constants, field)


@njit(nogil=True, cache=True, inline="always")
def grow_row(
    problem: Problem,
    cell: NDArray[np.int32],
    best: NDArray[np.float32],
    m: np.float32,
    finest: bool,
    constants: Constants,
    field: NDArray[np.float32],
) -> None:
    """Fit the weights of one row, with more and more cells until the fit stops improving.

    Parameters
    ----------
    problem : Problem
    cell : (s,) int32
        Candidates, s at least 1.
    best : (s,) float32
        Their weights, 0 at first; changed.
    m : float32
        Number of usable measurements, above 0.
    finest, constants
        As in :func:`grow_rows`.
    field : (rows + 2, columns + 2) float32
        Working space, all zero before and after.
    """
    s = cell.size
    most = min(max(int(constants.sparsity * m), 1) if finest else max(int(m), 1), s)
    residual = problem.target.copy()
    misfit = inner(residual, residual)
    penalty = 2 * np.log(max(s, 2))
    proxy, x, chosen = np.empty(s, np.float32), np.empty(s, np.float32), np.empty(s, np.bool_)
    k = min(1, most)
    while True:
        before, cells = misfit, np.count_nonzero(best)
        for _ in range(constants.rounds):
            pruned = add_and_prune(problem, cell, best, k, m, residual, constants, field, proxy, x, chosen)
            new_misfit = inner(pruned, pruned)
            stalled = new_misfit >= (1 - constants.stall) * misfit
            if new_misfit < misfit:
                residual, misfit = pruned, new_misfit
                for j in range(s):
                    best[j] = x[j]
            if stalled:
                break
        gain = m * np.log(before / max(misfit, 1e-30))
        no_gain = gain <= penalty * (np.count_nonzero(best) - cells)
        converged = finest and no_gain and abs(best.sum() - 1) <= constants.sum_tolerance
        if converged or k == most:
            break
        k = min(max(k + 1, int(k * constants.growth)), most)
    if finest:
        group_sums(cell, best, problem.columns, field, proxy)
        for j in range(s):
            chosen[j] = best[j] > 0 and proxy[j] > np.sqrt(penalty * misfit) / m
        solve_chosen(problem, cell, chosen, best, constants)


@njit(nogil=True, cache=True, inline="always")
def add_and_prune(
    problem: Problem,
    cell: NDArray[np.int32],
    best: NDArray[np.float32],
    k: int,
    m: np.float32,
    residual: NDArray[np.float32],
    constants: Constants,
    field: NDArray[np.float32],
    proxy: NDArray[np.float32],
    x: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """One round: add the k groups of cells with the largest proxies, solve, keep the k best groups, solve again.

    The weights are written to `x`; their residual is returned. `proxy` and `chosen` are working space.
    """
    correlate(problem.light, cell, problem.scale, residual, proxy)
    for j in range(cell.size):
        proxy[j] = max(best[j] + proxy[j] / m, 0)
    choose_groups(cell, proxy, k, problem.columns, field, chosen)
    for j in range(cell.size):
        chosen[j] = chosen[j] or best[j] > 0
        x[j] = best[j]
    solve_chosen(problem, cell, chosen, x, constants)
    choose_groups(cell, x, k, problem.columns, field, chosen)
    pruned: NDArray[np.float32] = solve_chosen(problem, cell, chosen, x, constants)
    return pruned


@njit(nogil=True, cache=True)
def correlate(
    light: NDArray[np.float32],
    cell: NDArray[np.int32],
    scale: NDArray[np.float32],
    residual: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write the inner products of a residual with each cell's scaled +-1 light.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the channels, 0 to 1.
    cell : (s,) int32
        Cells.
    scale, residual : (channels * m,) float32
        Factor and residual of each measurement.
    out : (s,) float32
        Written.
    """
    m = light.shape[2]
    scaled = scale * residual
    all_black = np.float32(0)
    for k in range(scaled.size):
        all_black -= scaled[k]
    for j in range(cell.size):
        out[j] = all_black
    for c in range(light.shape[0]):
        part = scaled[c * m : (c + 1) * m]
        for j in range(cell.size):
            out[j] += 2 * inner(light[c, cell[j]], part)


@njit(nogil=True, cache=True)
def choose_groups(
    cell: NDArray[np.int32],
    value: NDArray[np.float32],
    k: int,
    columns: int,
    field: NDArray[np.float32],
    chosen: NDArray[np.bool_],
) -> None:
    """Mark the k cells of positive value whose group has the most energy; the first ones if equal.

    Parameters
    ----------
    cell, columns, field
        As in :func:`~workflows.recovery.dgsr.groups.group_sums`.
    value : (s,) float32
        Zero or more. A group's energy is the cell's squared value plus half the sum of its neighbours' squared values.
    k : int
        1 or more.
    chosen : (s,) bool
        Written.
    """
    energy = np.empty_like(value)
    group_sums(cell, value * value, columns, field, energy)
    best = np.empty(k, np.int64)  # the cells with most energy so far, in descending order
    count = 0
    for j in range(value.size):
        chosen[j] = False
        if value[j] <= 0 or (count == k and energy[j] <= energy[best[k - 1]]):
            continue
        place = min(count, k - 1)
        count = place + 1
        while place > 0 and energy[best[place - 1]] < energy[j]:
            best[place] = best[place - 1]
            place -= 1
        best[place] = j
    for i in range(count):
        chosen[best[i]] = True


@njit(nogil=True, cache=True)
def solve_chosen(
    problem: Problem,
    cell: NDArray[np.int32],
    chosen: NDArray[np.bool_],
    x: NDArray[np.float32],
    constants: Constants,
) -> NDArray[np.float32]:
    """Non-negative least squares on some of the candidates, starting from x.

    Parameters
    ----------
    problem : Problem
    cell : (s,) int32
        Candidates.
    chosen : (s,) bool
        Candidates whose weight may be above zero.
    x : (s,) float32
        The start; overwritten with the result.
    constants : Constants
        `sweeps` and `tolerance` are used.

    Returns
    -------
    (c * m,) float32
        The residual.
    """
    index = np.flatnonzero(chosen)
    matrix, y = np.empty((index.size, problem.target.size), np.float32), x[index]
    stack_rows(problem.light, cell[index], problem.scale, matrix)
    residual: NDArray[np.float32] = solve_nnls(
        matrix, problem.target, y, constants.sweeps, constants.tolerance
    )
    x[:] = 0
    for i in range(index.size):
        x[index[i]] = y[i]
    return residual
