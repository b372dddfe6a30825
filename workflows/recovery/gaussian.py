"""The paper's Gaussian prior: oriented Gaussians fitted on the fly to the clusters of a T, and T filtered by them."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.solvers import inner, posterior_mean, stack_rows, subtract

# A lobe is never narrower than a cell: this is the variance of one, in cells squared.
CELL_VARIANCE = 1 / 12
# Of a Gaussian: its weight, centre, variances and covariance.
PARAMETERS = 6
# A cell with less of a T than this is no part of it; a Gaussian neither.
_LEAST_MASS = 1e-6


@njit(nogil=True, cache=True)
def filter_rows(
    light: NDArray[np.float32],
    source: NDArray[np.int64],
    scale: NDArray[np.float32],
    target: NDArray[np.float32],
    variance: NDArray[np.float64],
    begin: NDArray[np.int64],
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    columns: int,
    rows: int,
    clusters: int,
    reach: float,
    fits: int,
    stall: float,
    steps: int,
    precision: float,
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Filter sparse rows by Gaussians, those that they explain better than the row's own cells do.

    Parameters
    ----------
    light, source, scale, target
        As in :func:`~workflows.recovery.pursuit.grow_rows`.
    variance : (n,) float64
        Of a row's scaled measurements.
    begin, cell, weight
        Rows as in :class:`~workflows.recovery.groups.Rows`; a cell of weight 0 was a candidate.
    columns, rows : int
        The grid.
    clusters, reach, fits, stall, steps, precision
        As in :func:`~workflows.recovery.dgsr.recover`.

    Returns
    -------
    begin, cell, weight
        The filtered rows; cells need not have been candidates.

    Notes
    -----
    k cells out of s candidates cost ``2 k ln s`` and their misfit ``n ln(|f - A t|^2 / n)``, as if at least the
    noise's; Gaussians cost what :func:`filter_row` says.
    """
    channels = scale.shape[1] // light.shape[2]
    field = np.zeros((clusters, rows, columns), np.float32)
    n = source.size
    new_begin = np.zeros(n + 1, np.int64)
    new_cell, new_weight = np.empty(1024, np.int32), np.empty(1024, np.float32)
    end = 0
    for p in range(n):
        own, x = cell[begin[p] : begin[p + 1]], weight[begin[p] : begin[p + 1]]
        lit = np.flatnonzero(x > 0)
        found_cell, found = own[lit], x[lit]
        if lit.size > 0:
            seen = light[source[p] : source[p] + channels]
            matrix = np.empty((lit.size, target.shape[1]), np.float32)
            stack_rows(seen, found_cell, scale[p], matrix)
            residual = target[p].copy()
            for j in range(lit.size):
                subtract(residual, found[j], matrix[j])
            m = inner(scale[p], scale[p])
            plain = m * math.log(max(inner(residual, residual) / m, variance[p]))
            plain += 2 * math.log(max(own.size, 2)) * lit.size
            score, filtered_cell, filtered = filter_row(
                seen,
                scale[p],
                target[p],
                variance[p],
                columns,
                found_cell,
                found,
                clusters,
                reach,
                fits,
                stall,
                steps,
                precision,
                field,
            )
            if score < plain:
                found_cell, found = filtered_cell, filtered
        while end + found.size > new_cell.size:
            new_cell = np.concatenate((new_cell, np.empty_like(new_cell)))
            new_weight = np.concatenate((new_weight, np.empty_like(new_weight)))
        for j in range(found.size):
            new_cell[end], new_weight[end] = found_cell[j], found[j]
            end += 1
        new_begin[p + 1] = end
    return new_begin, new_cell[:end].copy(), new_weight[:end].copy()


@njit(nogil=True, cache=True)
def filter_row(
    light: NDArray[np.float32],
    scale: NDArray[np.float32],
    target: NDArray[np.float32],
    variance: float,
    columns: int,
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    clusters: int,
    reach: float,
    fits: int,
    stall: float,
    steps: int,
    precision: float,
    field: NDArray[np.float32],
) -> tuple[float, NDArray[np.int32], NDArray[np.float32]]:
    """Filter a T by oriented Gaussians, again and again fitted to its clusters.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the channels that the measurements belong to, 0 to 1.
    scale, target : (channels * m,) float32
        The measurements in +-1 form, each scaled so that all have one variance, and the scales.
    variance : float
        That variance.
    columns : int
        Columns of the grid.
    cell, weight : (s,) int32, float32
        The T to start from, s at least 1, of positive weights.
    clusters : int
        Most clusters.
    reach : float
        What is further than this many standard deviations from all Gaussians is taken out.
    fits : int
        Most rounds of fitting and filtering for a number of clusters.
    stall : float
        They end when one takes less than this share off the Gaussians' squared misfit.
    steps, precision
        As in :func:`~workflows.recovery.solvers.posterior_mean`.
    field : (clusters, rows, columns) float32
        Working space, all zero before and after.

    Returns
    -------
    score : float
        Minus twice the log-likelihood of the best Gaussians, plus 2 for each of their parameters.
    cell, weight : (s,) int32, float32
        The T filtered by them.

    Notes
    -----
    With m the Gaussians' mass on each cell, together 1, T has the prior ``T ~ N(m, k diag m)`` (eq. 9): only cells
    inside a Gaussian may be lit, the more the more of it they hold. Its mean given the measurements f = A t of
    variance v is ``t = m + M A' (A M A' + v / k)^-1 (f - A m)``, M = diag m, cut off at 0. The most likely k has
    ``|f - A m|^2 = n (v + k)``, as each of the n rows of A is of +-1. The next Gaussians have the moments of this t.

    The clusters are Ward's, from every cell its own to `clusters` and fewer; the best number is kept.
    """
    n = inner(scale, scale)
    moments = np.zeros((cell.size, PARAMETERS))
    for j in range(cell.size):
        add_moments(moments[j], cell[j], columns, weight[j])
    count = cell.size
    best_score = np.inf
    best_cell, best_weight = cell, weight
    while True:
        count = merge_clusters(moments, count, clusters)
        gaussians = moments[:count].copy()
        lobes = count
        before = np.inf
        for _ in range(fits):
            inside, mass = spread(gaussians[:lobes], columns, reach, field)
            if inside.size == 0:
                break
            matrix = np.empty((inside.size, target.size), np.float32)
            stack_rows(light, inside, scale, matrix)
            mean = np.zeros(inside.size, np.float32)
            for i in range(lobes):
                for j in range(inside.size):
                    mean[j] += mass[i, j]
            residual = target.copy()
            for j in range(inside.size):
                subtract(residual, mean[j], matrix[j])
            misfit = inner(residual, residual)
            looseness = max(misfit / n - variance, 0.0)
            t = posterior_mean(matrix, residual, mean, variance, looseness, steps, precision)
            score = n * math.log(max(misfit / n, variance)) + 2 * PARAMETERS * lobes
            if score < best_score:
                best_score, best_cell, best_weight = score, inside, t
            if misfit >= (1 - stall) * before:
                break
            before = misfit
            kept = 0
            for i in range(lobes):
                for k in range(PARAMETERS):
                    gaussians[kept, k] = 0
                for j in range(inside.size):
                    if mass[i, j] > 0:
                        add_moments(gaussians[kept], inside[j], columns, t[j] * mass[i, j] / mean[j])
                kept += gaussians[kept, 0] > _LEAST_MASS
            lobes = kept
        if count == 1:
            break
        clusters = count - 1
    return best_score, best_cell, best_weight


@njit(nogil=True, cache=True)
def add_moments(moments: NDArray[np.float64], cell: int, columns: int, weight: float) -> None:
    """Add a weight at a cell's centre to the raw moments of order 0 to 2: 1, x, y, xx, xy, yy."""
    row, column = divmod(cell, columns)
    x, y = column + 0.5, row + 0.5
    moments[0] += weight
    moments[1] += weight * x
    moments[2] += weight * y
    moments[3] += weight * x * x
    moments[4] += weight * x * y
    moments[5] += weight * y * y


@njit(nogil=True, cache=True)
def merge_clusters(moments: NDArray[np.float64], count: int, most: int) -> int:
    """Merge clusters until there are no more than `most`.

    Parameters
    ----------
    moments : (n, 6) float64
        Raw moments of the clusters, of positive weight; the first `count` are overwritten.
    count, most : int
        How many there are, and may be.

    Returns
    -------
    int
        How many are left.

    Notes
    -----
    Always the two whose merger adds least to the squared distances from the centres,
    ``w_a w_b / (w_a + w_b) |c_a - c_b|^2`` (Ward, "Hierarchical grouping to optimize an objective function",
    J. Am. Stat. Assoc., 1963).
    """
    while count > most:
        least, first, second = np.inf, 0, 1
        for a in range(count):
            wa = moments[a, 0]
            xa, ya = moments[a, 1] / wa, moments[a, 2] / wa
            for b in range(a + 1, count):
                wb = moments[b, 0]
                dx, dy = moments[b, 1] / wb - xa, moments[b, 2] / wb - ya
                cost = wa * wb / (wa + wb) * (dx * dx + dy * dy)
                if cost < least:
                    least, first, second = cost, a, b
        count -= 1
        for k in range(PARAMETERS):
            moments[first, k] += moments[second, k]
            moments[second, k] = moments[count, k]
    return count


@njit(nogil=True, cache=True)
def spread(
    moments: NDArray[np.float64], columns: int, reach: float, field: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The mass of Gaussians on the cells of a grid.

    Parameters
    ----------
    moments : (q, 6) float64
        Raw moments; a Gaussian has their mean and covariance less a cell's own.
    columns : int
        Columns of the grid.
    reach : float
        Standard deviations at which a Gaussian ends.
    field : (q or more, rows, columns) float32
        Working space, all zero before and after.

    Returns
    -------
    cell : (s,) int32
        Cells that hold some, ascending.
    mass : (q, s) float32
        Each Gaussian's on them; together 1.

    Notes
    -----
    A Gaussian is integrated over each row, and over the columns given the row, whose x is taken to be normal with
    the mean and the variance that it has there.
    """
    q, rows = moments.shape[0], field.shape[1]
    left = np.full(rows, columns, np.int64)
    right = np.full(rows, -1, np.int64)
    total = 0.0
    for i in range(q):
        w = moments[i, 0]
        x, y = moments[i, 1] / w, moments[i, 2] / w
        xx = max(moments[i, 3] / w - x * x - CELL_VARIANCE, CELL_VARIANCE)
        yy = max(moments[i, 5] / w - y * y - CELL_VARIANCE, CELL_VARIANCE)
        # what the floor or rounding left degenerate stays an ellipse
        limit = 0.99 * math.sqrt(xx * yy)
        xy = min(max(moments[i, 4] / w - x * y, -limit), limit)
        slope = xy / yy
        narrow = xx - slope * xy
        sigma = math.sqrt(yy)
        for r in range(max(int(y - reach * sigma), 0), min(int(y + reach * sigma) + 1, rows)):
            a, b = (r - y) / sigma, (r + 1 - y) / sigma
            share = 0.5 * (math.erf(b / math.sqrt(2.0)) - math.erf(a / math.sqrt(2.0)))
            if share < _LEAST_MASS:
                continue
            pa = math.exp(-a * a / 2) / math.sqrt(2 * math.pi) / share
            pb = math.exp(-b * b / 2) / math.sqrt(2 * math.pi) / share
            inner_yy = min(max(yy * (1 + a * pa - b * pb - (pa - pb) ** 2), 0.0), CELL_VARIANCE)
            middle = x + slope * sigma * (pa - pb)
            width = math.sqrt(narrow + slope * slope * inner_yy)
            start = max(int(middle - reach * width), 0)
            stop = min(int(middle + reach * width) + 1, columns)
            if start >= stop:
                continue
            edge = math.erf((start - middle) / width / math.sqrt(2.0))
            for c in range(start, stop):
                ahead = math.erf((c + 1 - middle) / width / math.sqrt(2.0))
                held = w * share * 0.5 * (ahead - edge)
                field[i, r, c] = held
                total += held
                edge = ahead
            left[r], right[r] = min(left[r], start), max(right[r], stop - 1)
    size = 0
    for r in range(rows):
        size += max(right[r] - left[r] + 1, 0)
    cell, mass = np.empty(size, np.int32), np.empty((q, size), np.float32)
    s = 0
    for r in range(rows):
        for c in range(left[r], right[r] + 1):
            held = 0.0
            for i in range(q):
                mass[i, s] = field[i, r, c] / total
                held += mass[i, s]
                field[i, r, c] = 0
            cell[s] = r * columns + c
            s += held > _LEAST_MASS
    return cell[:s].copy(), mass[:, :s].copy()
