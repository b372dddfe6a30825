"""How many lobes a T has, and where: each is looked for where it explains most, from coarse nodes to fine ones."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import PARAMETERS, Shown, fit_level
from workflows.recovery.lobes.likelihood import price, weigh
from workflows.recovery.lobes.mixture import Mixture, copy_mixture, refine
from workflows.recovery.lobes.options import LobesOptions

# Rounds of a further lobe go on while it is no worse than this behind in -2 ln likelihood.
_HOPE = 30.0
_NEVER = 1e30


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
    shown: Shown,
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    beam: int,
) -> tuple[int, int, int, float, float]:
    """Find the node where more light would explain most, from the coarsest grid to ever finer ones.

    Parameters
    ----------
    shown : Shown
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
    columns, rows, starts = shown.grids
    groups, m = shown.groups, shown.m
    size = groups * m
    codes_of_f, residual = np.empty(size, np.float32), np.empty(size, np.float32)
    weight = np.empty(size, np.float32)
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
            codes = shown.code[starts[level] + row * wide + column, shown.first : shown.first + size]
            z, much = score(codes, codes_of_f, residual, weight)
            z_found = max(z_found, z)
            if z > 0 and z * z - place > gain:
                best_level, best_column, best_row = level, column, row
                gain, amount, best_z = z * z - place, much, z
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
    shown: Shown,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    options: LobesOptions,
) -> tuple[int, float, float]:
    """Fit as many lobes to a pixel as pay for themselves.

    Parameters
    ----------
    shown, y, variance
        As in :func:`~workflows.recovery.lobes.mixture.refine`.
    mixture : Mixture
        The first k lobes are the start; changed. There is room for `options.most_lobes`.
    k : int
    options : LobesOptions

    Returns
    -------
    k : int
        Lobes; one at least.
    kappa, objective : float
        As from :func:`~workflows.recovery.lobes.likelihood.weigh`.
    """
    grids, groups, m = shown.grids, shown.groups, shown.m
    f, precision = np.zeros_like(y), np.empty_like(y)
    for g in range(groups):
        # light from everywhere: of a pattern its mean, about nothing
        f[g * (m + 2) + m], f[g * (m + 2) + m + 1] = -1.0, 1.0
    if k > 0:
        kappa, objective, f, precision = refine(shown, y, variance, mixture, k, options, _NEVER)
        objective += price(grids, mixture.level, k)
    else:
        kappa, objective = weigh(y, f, variance, groups, groups, precision)
        objective = _NEVER
    tried = Mixture(mixture.lobes.copy(), mixture.level.copy(), mixture.offset.copy())
    while k < options.most_lobes:
        at, column, row, gain, amount = search(shown, y, f, precision, options.beam)
        if k > 0 and gain < 2 * (PARAMETERS - 2):
            break
        if at < 0:  # nothing says anything: light from everywhere
            at, column, row = grids.columns.size - 1, grids.columns[-1] // 2, grids.rows[-1] // 2
        copy_mixture(k, groups, mixture, tried)
        spacing = 2.0**at
        share = min(max(amount, 0.02), 1.0) if k > 0 else 1.0
        for i in range(k):
            tried.lobes[i, 0] *= 1 - share
        lobe = tried.lobes[k]
        lobe[0], lobe[1], lobe[2] = share, (column + 0.5) * spacing, (row + 0.5) * spacing
        lobe[3], lobe[4], lobe[5] = 0.8 * spacing, 0.0, 0.8 * spacing
        tried.level[k] = fit_level(lobe, at, grids.columns, options.fit_resolution)
        new_kappa, new, new_f, new_precision = refine(
            shown, y, variance, tried, k + 1, options, objective + _HOPE
        )
        new += price(grids, tried.level, k + 1)
        if new >= objective:
            break
        k += 1
        kappa, objective, f, precision = new_kappa, new, new_f, new_precision
        copy_mixture(k, groups, tried, mixture)
    return k, kappa, objective - price(grids, mixture.level, k)
