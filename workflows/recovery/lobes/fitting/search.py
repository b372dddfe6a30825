"""The number of lobes of a T and their starting points: lobes are added where they improve the fit most."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.levenberg_marquardt import refine
from workflows.recovery.lobes.fitting.scores import in_codes, insert, score, see
from workflows.recovery.lobes.footprint import PARAMETERS, PatternCodes, fit_level, parts_of
from workflows.recovery.lobes.likelihood import penalty, weigh
from workflows.recovery.lobes.mixture import Mixture, Workspace, clone, copy_mixture
from workflows.recovery.lobes.options import LobesOptions
from workflows.recovery.pyramid import Grids

# The fit of another lobe is abandoned after a round that leaves -2 ln likelihood higher than before by more than this.
_MOST_LOSS = 30.0
_HUGE = 1e30
# All steps are tried: far from the solution they may lower chi-square by more than expected.
_ANY = 0.0
# How many times as many nodes are examined for the first lobe. Most of the light comes from it, and a wrong one
# is not found out. Where lobes are dispersed, each node is examined in more ways instead.
_FIRST = 4
# Farthest that the search for a first lobe moves blue from green along an axis, in cells.
_MOST_DISPERSION = 24.0
# Nodes to each side of a lobe's centre and ends that are examined for another one.
_NEAR = 8
# They are examined where lobes leave more than this variance of a black-and-white pattern (-1 to 1) unexplained.
_MUCH = 0.03
# A lobe that is found there must lower -2 ln likelihood by this much more than its penalty: few measurements are
# explained as well by several sets of lobes.
_DOUBT = 12.0
# Least share of chi-square that counts as left unexplained by a first node.
_LEAST_LEFT = 1e-6


@njit(nogil=True, cache=True)
def find_node(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    beam: int,
    first: bool,
    dispersion: NDArray[np.float64],
) -> tuple[int, int, int, float, float]:
    """Find the node where more light would improve the fit most, by a beam search from the coarsest grid to finer ones.

    Parameters
    ----------
    patterns : PatternCodes
    y, f, precision : (groups (m + 2),) float32
        Measurements, prediction, and precisions.
    beam : int
        Nodes of a grid whose children are scored.
    first : bool
        Whether there is no lobe yet. The precisions are then those of measurements that nothing explains, so their
        scale is unknown.
    dispersion : (2,) float64
        As of :class:`~workflows.recovery.lobes.mixture.Mixture`. Written for the first lobe, if the patterns are
        dispersed: each child of a node then has nine values of it, one spacing of the grid apart.

    Returns
    -------
    level, column, row : int
        The node; level -1 if no node would improve the fit.
    gain : float
        Gain in -2 ln likelihood, less the penalty of a centre on that level.
    amount : float
        Light to move there, as a share.

    Notes
    -----
    Moving light to a node lowers chi-square by z^2. The gain is z^2 where the variances are known. Where they are known
    only up to a factor, its maximum likelihood estimate from m measurements gives ``m ln(chi^2 / (chi^2 - z^2))``: what
    a node explains of all there is to explain. A node of the finest grid that explains everything then outweighs the
    wide one about it, which the fit could not make narrow.
    """
    columns, rows, starts = patterns.grids
    code = patterns.code  # once, not for each node: what is taken out of a tuple is counted as a reference
    code_of_f, residual, weight = in_codes(patterns, y, f, precision)
    best_level, best_column, best_row, gain, best_z = -1, 0, 0, -_HUGE, 0.0
    nodes = np.empty(parts_of(patterns)[0], np.int64)
    ways = 9 if first and patterns.dispersed else 1
    if first and ways == 1:
        beam *= _FIRST
    # column and row, and the dispersion in spacings of the grid
    parents, scores = np.empty((beam, 4), np.int64), np.empty(beam)
    children = np.empty((beam, 4), np.int64)
    count = 0
    chi, used = 0.0, 0
    for j in range(weight.size):
        if weight[j] > 0:
            chi += residual[j] ** 2 / weight[j]
            used += 1
    for level in range(columns.size - 1, -1, -1):
        wide, high, spacing = columns[level], rows[level], 2.0**level
        grid, apart = (wide, high, starts[level]), (dispersion[0] / spacing, dispersion[1] / spacing)
        whole = level == columns.size - 1
        found = 0
        for p in range(wide * high if whole else 4 * ways * count):
            across, down = 0, 0
            if whole:
                column, row = p % wide, p // wide
            else:
                parent, way = p // (4 * ways), p // 4 % ways
                column, row = 2 * parents[parent, 0] + p % 2, 2 * parents[parent, 1] + p % 4 // 2
                if ways > 1:
                    across, down = 2 * parents[parent, 2] + way % 3 - 1, 2 * parents[parent, 3] + way // 3 - 1
            if column >= wide or row >= high or max(abs(across), abs(down)) * spacing > _MOST_DISPERSION:
                continue
            if ways > 1:
                apart = float(across), float(down)
            see(grid, column, row, apart, nodes)
            z, _ = score(code, nodes, patterns.first, code_of_f, residual, weight)
            found = insert(z, (column, row, across, down), scores, children, found)
        z = scores[0]
        if z > 0:
            explained = used * math.log(chi / max(chi - z * z, _LEAST_LEFT * chi)) if first else z * z
            if explained - 2 * math.log(wide * high) > gain:
                best_level, best_column, best_row = level, children[0, 0], children[0, 1]
                gain, best_z = explained - 2 * math.log(wide * high), z
                if ways > 1:
                    dispersion[0], dispersion[1] = children[0, 2] * spacing, children[0, 3] * spacing
        if z < 0.7 * best_z:
            break
        count = found
        parents, children = children, parents
    amount = 0.0
    if best_level >= 0:
        spacing = 2.0**best_level
        grid = columns[best_level], rows[best_level], starts[best_level]
        see(grid, best_column, best_row, (dispersion[0] / spacing, dispersion[1] / spacing), nodes)
        _, amount = score(code, nodes, patterns.first, code_of_f, residual, weight)
    return best_level, best_column, best_row, gain, amount


@njit(nogil=True, cache=True)
def find_near(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    precision: NDArray[np.float32],
    mixture: Mixture,
    k: int,
) -> tuple[int, int, int, float, float]:
    """Find the node about the centres and the ends of k lobes where more light would improve the fit most.

    A lobe that lies across two places has light between them, where there is none. On coarse grids this hides what is
    missing at its ends, so that :func:`find_node` does not get there.

    Parameters
    ----------
    patterns, y, f, precision
        As in :func:`find_node`.
    mixture : Mixture
    k : int

    Returns
    -------
    level, column, row, gain, amount
        As from :func:`find_node`. Its level is at most that of the lobe.
    """
    code_of_f, residual, weight = in_codes(patterns, y, f, precision)
    best = (-1, 0, 0, -_HUGE, 0.0)
    for i in range(k):
        for end in range(-1, 2):
            across, down = _along(mixture.lobes[i], end)
            for level in range(mixture.level[i] + 1):
                best = _best_about(
                    patterns, level, across, down, mixture.dispersion, code_of_f, residual, weight, best
                )
    return best


@njit(nogil=True, cache=True)
def _along(lobe: NDArray[np.float64], deviations: float) -> tuple[float, float]:
    """The place so many standard deviations from a lobe's centre along its major axis, in cells of the first grid."""
    xx, xy, yy = lobe[3] ** 2, lobe[3] * lobe[4], lobe[4] ** 2 + lobe[5] ** 2
    angle = math.atan2(2 * xy, xx - yy) / 2
    major = math.sqrt((xx + yy) / 2 + math.hypot((xx - yy) / 2, xy))
    return lobe[1] + deviations * major * math.cos(angle), lobe[2] + deviations * major * math.sin(angle)


@njit(nogil=True, cache=True)
def _best_about(
    patterns: PatternCodes,
    level: int,
    across: float,
    down: float,
    dispersion: NDArray[np.float64],
    code_of_f: NDArray[np.float32],
    residual: NDArray[np.float32],
    weight: NDArray[np.float32],
    best: tuple[int, int, int, float, float],
) -> tuple[int, int, int, float, float]:
    """The best of the nodes of a level about a place and of the best so far, both as of `find_near`."""
    wide, high, spacing = patterns.grids.columns[level], patterns.grids.rows[level], 2.0**level
    grid, code = (wide, high, patterns.grids.starts[level]), patterns.code
    apart = dispersion[0] / spacing, dispersion[1] / spacing
    c, r = int(across / spacing), int(down / spacing)
    centre = 2 * math.log(wide * high)
    nodes = np.empty(parts_of(patterns)[0], np.int64)
    for row in range(max(r - _NEAR, 0), min(r + _NEAR + 1, high)):
        for column in range(max(c - _NEAR, 0), min(c + _NEAR + 1, wide)):
            see(grid, column, row, apart, nodes)
            z, amount = score(code, nodes, patterns.first, code_of_f, residual, weight)
            if z > 0 and z * z - centre > best[3]:
                best = (level, column, row, z * z - centre, amount)
    return best


@njit(nogil=True, cache=True)
def _add_lobe(
    mixture: Mixture,
    k: int,
    grids: Grids,
    level: int,
    column: int,
    row: int,
    amount: float,
    resolution: float,
) -> None:
    """Add lobe k at a node, with a share of the light of the others; a wide one at the centre if level is -1."""
    if level < 0:
        level, column, row = grids.columns.size - 1, grids.columns[-1] // 2, grids.rows[-1] // 2
    spacing = 2.0**level
    share = min(max(amount, 0.02), 1.0) if k > 0 else 1.0
    for i in range(k):
        mixture.lobes[i, 0] *= 1 - share
    lobe = mixture.lobes[k]
    lobe[0], lobe[1], lobe[2] = share, (column + 0.5) * spacing, (row + 0.5) * spacing
    lobe[3], lobe[4], lobe[5] = 0.8 * spacing, 0.0, 0.8 * spacing
    mixture.level[k] = fit_level(lobe, level, grids.columns, resolution)


@njit(nogil=True, cache=True)
def fit(
    patterns: PatternCodes,
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    mixture: Mixture,
    k: int,
    options: LobesOptions,
    workspace: Workspace,
) -> tuple[int, float, float]:
    """Fit lobes to a pixel, as many as lower -2 ln likelihood by more than their penalty.

    Parameters
    ----------
    patterns, y, variance
        As in :func:`~workflows.recovery.lobes.fitting.levenberg_marquardt.refine`.
    mixture : Mixture
        Starts from its first k lobes and is changed in place; its arrays hold `options.most_lobes`.
    k : int
    options : LobesOptions
    workspace : Workspace

    Returns
    -------
    k : int
        Number of lobes, at least 1.
    kappa, objective : float
        As from :func:`~workflows.recovery.lobes.likelihood.weigh`.
    """
    grids, groups, m = patterns.grids, patterns.groups, patterns.m
    strays = groups * len(patterns.strays)
    f, precision = np.zeros_like(y), np.empty_like(y)
    for g in range(groups):
        # initial prediction: light from the whole monitor, where patterns have a mean of about 0
        f[g * (m + 2) + m], f[g * (m + 2) + m + 1] = -1.0, 1.0
    if k > 0:
        kappa, objective, f, precision = refine(
            patterns, y, variance, mixture, k, options, workspace, _ANY, _HUGE
        )
        objective += penalty(grids, mixture.level, k)
    else:
        kappa, objective = weigh(y, f, variance, groups, groups, precision)
        objective = _HUGE
    tried = clone(mixture)
    near = False
    while k < options.most_lobes:
        if near:
            level, column, row, gain, amount = find_near(patterns, y, f, precision, mixture, k)
        else:
            level, column, row, gain, amount = find_node(
                patterns, y, f, precision, options.beam, k == 0, mixture.dispersion
            )
        better = k == 0 or gain >= 2 * (PARAMETERS - 2)
        if better:
            copy_mixture(k, strays, mixture, tried)
            _add_lobe(tried, k, grids, level, column, row, amount, options.fit_resolution)
            new_kappa, new, new_f, new_precision = refine(
                patterns,
                y,
                variance,
                tried,
                k + 1,
                options,
                workspace,
                _ANY,
                objective + _MOST_LOSS,
            )
            new += penalty(grids, tried.level, k + 1)
            better = new < objective - (_DOUBT if near else 0.0)
        if better:
            k += 1
            kappa, objective, f, precision = new_kappa, new, new_f, new_precision
            copy_mixture(k, strays, tried, mixture)
        elif near or kappa <= _MUCH:
            break
        near = not better
    return k, kappa, objective - penalty(grids, mixture.level, k)
