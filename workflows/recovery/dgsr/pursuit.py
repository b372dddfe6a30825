"""The search for the cells of a T: non-negative dynamic group sparsity, kernels on the rows of many pixels."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.dgsr.groups import Rows, group_sums
from workflows.recovery.dgsr.options import Constants
from workflows.recovery.solvers import descend, inner, stack_rows


class System(NamedTuple):
    """The measurements that rows of T on a level's grid are solved from.

    Attributes
    ----------
    light : (channels, cells, m) float32
        Light of the level, 0 to 1.
    columns, rows : int
        The level's grid.
    source : (n,) int64
        First channel of `light` that a row's measurements belong to.
    scale, target : (n, c * m) float32
        Measurements in +-1 form of c channels, scaled to one variance, and the scales: zero where a measurement
        says nothing.
    variance : (n,) float64
        Of a row's scaled measurements.
    """

    light: NDArray[np.float32]
    columns: int
    rows: int
    source: NDArray[np.int64]
    scale: NDArray[np.float32]
    target: NDArray[np.float32]
    variance: NDArray[np.float64]


@njit(nogil=True, cache=True)
def grow_rows(system: System, found: Rows, finest: bool, constants: Constants) -> None:
    """Fit the weights of sparse rows to measurements by NN-DGSR, from zero.

    Parameters
    ----------
    system : System
    found : Rows
        Candidates; weights are overwritten.
    finest : bool
        Whether to stop growing, and to drop cells, where more cells explain nothing.
    constants : Constants
    """
    light, columns, rows, source, scale, target, _ = system
    begin, cell, weight = found
    sweeps, tolerance = constants.sweeps, constants.tolerance
    field = np.zeros((rows + 2, columns + 2), np.float32)
    channels = scale.shape[1] // light.shape[2]
    for p in range(source.size):
        own, best = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        s = own.size
        best[:] = 0
        m = inner(scale[p], scale[p])
        if s == 0 or m <= 0:
            continue
        seen = light[source[p] : source[p] + channels]
        most = min(max(int(constants.sparsity * m), 1) if finest else max(int(m), 1), s)
        residual = target[p].copy()
        left = inner(residual, residual)
        price = 2 * np.log(max(s, 2))
        proxy, x = np.empty(s, np.float32), np.empty(s, np.float32)
        chosen = np.empty(s, np.bool_)
        k = 1
        while True:
            before, cells = left, np.count_nonzero(best)
            for _ in range(constants.rounds):
                correlate(seen, own, scale[p], residual, proxy)
                for j in range(s):
                    proxy[j] = max(best[j] + proxy[j] / m, 0)
                choose_groups(own, proxy, k, columns, field, chosen)
                for j in range(s):
                    chosen[j] = chosen[j] or best[j] > 0
                    x[j] = best[j]
                solve_chosen(seen, own, scale[p], target[p], chosen, x, sweeps, tolerance)
                choose_groups(own, x, k, columns, field, chosen)
                pruned = solve_chosen(seen, own, scale[p], target[p], chosen, x, sweeps, tolerance)
                now = inner(pruned, pruned)
                stalled = now >= (1 - constants.stall) * left
                if now < left:
                    residual, left = pruned, now
                    for j in range(s):
                        best[j] = x[j]
                if stalled:
                    break
            gain = m * np.log(before / max(left, 1e-30))
            enough = gain <= price * (np.count_nonzero(best) - cells)
            settled = finest and enough and abs(best.sum() - 1) <= constants.sum_tolerance
            if settled or k == most:
                break
            k = min(max(k + 1, int(k * constants.growth)), most)
        if finest:
            group_sums(own, best, columns, field, proxy)
            for j in range(s):
                chosen[j] = best[j] > 0 and proxy[j] > np.sqrt(price * left) / m
            solve_chosen(seen, own, scale[p], target[p], chosen, best, sweeps, tolerance)


@njit(nogil=True, cache=True)
def correlate(
    light: NDArray[np.float32],
    cell: NDArray[np.int32],
    scale: NDArray[np.float32],
    residual: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write the inner products of a residual with the scaled +-1 light of cells.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the channels, 0 to 1.
    cell : (s,) int32
        Cells.
    scale, residual : (channels * m,) float32
        Factor of each measurement, and what it leaves.
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
    """Mark the k cells of positive value whose group has the most energy; of equal ones the first.

    Parameters
    ----------
    cell, columns, field
        As in :func:`~workflows.recovery.dgsr.groups.group_sums`.
    value : (s,) float32
        Zero or more; a group's energy is the cell's squared value plus half of its neighbours'.
    k : int
        1 or more.
    chosen : (s,) bool
        Written.
    """
    energy = np.empty_like(value)
    group_sums(cell, value * value, columns, field, energy)
    best = np.empty(k, np.int64)  # the most energetic cells so far, falling
    found = 0
    for j in range(value.size):
        chosen[j] = False
        if value[j] <= 0 or (found == k and energy[j] <= energy[best[k - 1]]):
            continue
        place = min(found, k - 1)
        found = place + 1
        while place > 0 and energy[best[place - 1]] < energy[j]:
            best[place] = best[place - 1]
            place -= 1
        best[place] = j
    for i in range(found):
        chosen[best[i]] = True


@njit(nogil=True, cache=True)
def solve_chosen(
    light: NDArray[np.float32],
    cell: NDArray[np.int32],
    scale: NDArray[np.float32],
    target: NDArray[np.float32],
    chosen: NDArray[np.bool_],
    x: NDArray[np.float32],
    sweeps: int,
    tolerance: float,
) -> NDArray[np.float32]:
    """Non-negative least squares on some of the cells, from x.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the channels, 0 to 1.
    cell : (s,) int32
        Candidates.
    scale, target : (channels * m,) float32
        Factor of each measurement, and what the scaled rows of the candidates are to add up to.
    chosen : (s,) bool
        Candidates that may be above zero.
    x : (s,) float32
        The start; overwritten with the result.
    sweeps, tolerance
        As in :func:`~workflows.recovery.solvers.descend`.

    Returns
    -------
    (channels * m,) float32
        What is left of the target.
    """
    index = np.flatnonzero(chosen)
    matrix, y = np.empty((index.size, target.size), np.float32), x[index]
    stack_rows(light, cell[index], scale, matrix)
    residual: NDArray[np.float32] = descend(matrix, target, y, sweeps, tolerance)
    x[:] = 0
    for i in range(index.size):
        x[index[i]] = y[i]
    return residual
