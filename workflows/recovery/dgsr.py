"""The paper's recovery: hierarchical non-negative dynamic group sparsity (NN-DGSR), each channel on its own."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.groups import Rows, group_sums
from workflows.recovery.photometry import Noise, Photometry, normalise
from workflows.recovery.sensing import Sensing
from workflows.recovery.solvers import descend, inner, signed_rows
from workflows.recovery.transport import Transport

# Pixels at a time, so that the working arrays stay small whatever a caller passes.
_BLOCK = 256
# Rounds of pruning at one sparsity; they end earlier when one takes less than this share off the residual.
_ROUNDS = 10
_STALL = 0.01
# Precision of the least squares in each round.
_SWEEPS = 30
_TOLERANCE = 1e-4


def recover(
    measurements: NDArray[np.float32],
    photometry: Photometry,
    sensing: Sensing,
    noise: Noise,
    *,
    sparsity: float = 0.2,
    growth: float = 1.25,
    sum_tolerance: float = 0.02,
    least_group: float = 0.02,
    least_contrast: float = 3.0,
) -> Transport:
    """Recover T by NN-DGSR, level by level: only the children of a level's cells are unknowns at the next.

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values of n pixels under the m patterns.
    photometry : Photometry
        S and rho of the pixels.
    sensing : Sensing
        The program's levels, coarse to fine.
    noise : Noise
        Noise of a measurement; it tells which channels are too dark.
    sparsity : float
        Most cells of a row at the finest level, as a share of the measurements. Coarser levels may have as many
        as measurements: they only have to find the cells, and one missed there is lost.
    growth : float
        Factor by which the sparsity grows, from one cell, until more cells explain no more.
    sum_tolerance : float
        The sparsity grows on while the L1 norm of T is further than this from one.
    least_group : float
        A cell is refined if its weight plus half of its eight neighbours' is more than this.
    least_contrast : float
        A channel whose rho is below this many standard deviations of a mid-grey value gets an empty row.

    Returns
    -------
    Transport
        On the finest grid.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    Eq. 9 without its Gaussian prior, in the +-1 form of eq. 8: ``f = 2 (C - S) / rho - 1 = A t``, t >= 0. Each
    round takes the proxy ``t + A'(f - A t) / m``, keeps the cells whose squared proxy plus half of their
    neighbours' is largest, solves a non-negative least squares on them and the cells so far, and prunes the
    result in the same way (Huang, Huang and Metaxas, "Learning with dynamic group sparsity", ICCV 2009).

    Of s cells that explain nothing the best one still lowers ``m ln |r|^2`` by about ``2 ln s``. Growth at the
    finest level ends when it gains less than that a cell, and cells of a group worth less are dropped.
    """
    value, precision = normalise(measurements, photometry, noise, least_contrast)
    parts = []
    for first in range(0, max(len(value), 1), _BLOCK):
        block = value[first : first + _BLOCK]
        alive = precision[first : first + _BLOCK].max(axis=2, initial=0) > 0
        pixel, channel = map(np.ascontiguousarray, np.nonzero(alive))
        rows = Rows.whole(pixel.size, sensing.levels[0])
        for i, level in enumerate(sensing.levels):
            if i > 0:
                rows = rows.split(sensing.levels[i - 1], level, least_group, reach=0)
            grow_rows(
                np.ascontiguousarray(level.light),
                np.zeros_like(channel) if level.light.shape[0] == 1 else channel,
                np.ascontiguousarray(block[..., level.patterns][pixel, channel]),
                rows.begin,
                rows.cell,
                rows.weight,
                level.columns,
                level.rows,
                level is sensing.levels[-1],
                sparsity,
                growth,
                sum_tolerance,
            )
        index = np.full(alive.shape, -1)
        index[alive] = np.arange(pixel.size)
        parts.append(rows.transport(sensing.levels[-1], index))
    return Transport.concatenate(parts)


@njit(nogil=True, cache=True)
def grow_rows(
    light: NDArray[np.float32],
    source: NDArray[np.int64],
    value: NDArray[np.float32],
    begin: NDArray[np.int64],
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    columns: int,
    rows: int,
    finest: bool,
    sparsity: float,
    growth: float,
    sum_tolerance: float,
) -> None:
    """Fit the weights of sparse rows to measurements by NN-DGSR, from zero.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the level, 0 to 1.
    source : (n,) int64
        Channel of `light` that a row's measurements belong to.
    value : (n, m) float32
        Measurements in +-1 form.
    begin, cell, weight
        Candidates as in :class:`~workflows.recovery.groups.Rows`; weights are overwritten.
    columns, rows : int
        The level's grid.
    finest : bool
        Whether to stop growing, and to drop cells, where more cells explain nothing.
    sparsity, growth, sum_tolerance
        As in :func:`recover`.
    """
    n, m = value.shape
    field = np.zeros((rows + 2, columns + 2), np.float32)
    ones = np.ones(m, np.float32)
    most = max(int(sparsity * m), 1) if finest else m
    for p in range(n):
        own, best = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        s = own.size
        best[:] = 0
        if s == 0:
            continue
        matrix = np.empty((s, m), np.float32)
        signed_rows(light[source[p]], own, ones, 0, matrix)
        residual = value[p].copy()
        left = inner(residual, residual)
        price = 2 * np.log(max(s, 2))
        proxy, x = np.empty(s, np.float32), np.empty(s, np.float32)
        chosen = np.empty(s, np.bool_)
        k = 1
        while True:
            before, cells = left, np.count_nonzero(best)
            for _ in range(_ROUNDS):
                for j in range(s):
                    proxy[j] = max(best[j] + inner(matrix[j], residual) / m, 0)
                choose_groups(own, proxy, k, columns, field, chosen)
                for j in range(s):
                    chosen[j] = chosen[j] or best[j] > 0
                    x[j] = best[j]
                solve_chosen(matrix, value[p], chosen, x)
                choose_groups(own, x, k, columns, field, chosen)
                pruned = solve_chosen(matrix, value[p], chosen, x)
                now = inner(pruned, pruned)
                stalled = now >= (1 - _STALL) * left
                if now < left:
                    residual, left = pruned, now
                    for j in range(s):
                        best[j] = x[j]
                if stalled:
                    break
            gain = m * np.log(before / max(left, 1e-30))
            enough = gain <= price * (np.count_nonzero(best) - cells)
            settled = finest and enough and abs(best.sum() - 1) <= sum_tolerance
            if settled or k == min(most, s):
                break
            k = min(max(k + 1, int(k * growth)), most, s)
        if finest:
            group_sums(own, best, columns, field, proxy)
            for j in range(s):
                chosen[j] = best[j] > 0 and proxy[j] > np.sqrt(price * left) / m
            solve_chosen(matrix, value[p], chosen, best)


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
        As in :func:`~workflows.recovery.groups.group_sums`.
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
    matrix: NDArray[np.float32],
    target: NDArray[np.float32],
    chosen: NDArray[np.bool_],
    x: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Non-negative least squares on some of the cells, from x.

    Parameters
    ----------
    matrix : (s, m) float32
        One row a cell.
    target : (m,) float32
        What the rows are to add up to.
    chosen : (s,) bool
        Cells that may be above zero.
    x : (s,) float32
        The start; overwritten with the result.

    Returns
    -------
    (m,) float32
        The residual ``target - x matrix``.
    """
    index = np.flatnonzero(chosen)
    part, y = matrix[index], x[index]
    residual: NDArray[np.float32] = descend(part, target, y, _SWEEPS, _TOLERANCE)
    x[:] = 0
    for i in range(index.size):
        x[index[i]] = y[i]
    return residual
