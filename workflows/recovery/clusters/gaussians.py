"""Clusters of a row of T, described by their moments, and Gaussians with these moments integrated over cells."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

CELL_VARIANCE = 1 / 12
"""Variance of a uniform cell along an axis, in cells squared: the least variance of a Gaussian."""
PARAMETERS = 6
"""Parameters of a Gaussian: weight, mean (2), covariance (3)."""
LEAST_MASS = 1e-6
"""Cells and Gaussians with less mass than this are dropped."""


@njit(nogil=True, cache=True)
def add_moments(moments: NDArray[np.float64], cell: int, columns: int, weight: float) -> None:
    """Add a weight at a cell's centre to raw moments of order 0 to 2: 1, x, y, xx, xy, yy."""
    row, column = divmod(cell, columns)
    x, y = column + 0.5, row + 0.5
    moments[0] += weight
    moments[1] += weight * x
    moments[2] += weight * y
    moments[3] += weight * x * x
    moments[4] += weight * x * y
    moments[5] += weight * y * y


@njit("int64(float64[:, ::1], int64, int64)", nogil=True, cache=True)
def merge_clusters(moments: NDArray[np.float64], count: int, most: int) -> int:
    """Merge clusters until there are no more than `most`.

    Parameters
    ----------
    moments : (n, 6 or more) float64
        Raw moments of the clusters, of positive weight; further columns are added up too. The first `count` rows are
        overwritten.
    count : int
        Number of clusters.
    most : int
        Largest number to leave.

    Returns
    -------
    int
        Number of clusters left, in the first rows.

    Notes
    -----
    Each step merges the two clusters whose merger adds least to the squared distances from the centres,
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
        for k in range(moments.shape[1]):
            moments[first, k] += moments[second, k]
            moments[second, k] = moments[count, k]
    return count


@njit(nogil=True, cache=True)
def integrate_gaussians(
    moments: NDArray[np.float64], columns: int, reach: float, field: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Integrate Gaussians over the cells of a grid.

    Parameters
    ----------
    moments : (q, 6) float64
        Raw moments. A Gaussian has their mean, and their covariance less a cell's variance.
    columns : int
        Columns of the grid.
    reach : float
        Standard deviations at which a Gaussian is cut off.
    field : (q or more, rows, columns) float32
        Working space, all zero before and after.

    Returns
    -------
    cell : (s,) int32
        Cells with some mass, ascending.
    mass : (q, s) float32
        Mass of each Gaussian on each cell; the sum over both is 1.
    """
    q, rows = moments.shape[0], field.shape[1]
    left = np.full(rows, columns, np.int64)
    right = np.full(rows, -1, np.int64)
    total = 0.0
    for i in range(q):
        total = _integrate_gaussian(moments[i], reach, field[i], left, right, total)
    size = 0
    for r in range(rows):
        size += max(right[r] - left[r] + 1, 0)
    cell, mass = np.empty(size, np.int32), np.empty((q, size), np.float32)
    s = 0
    for r in range(rows):
        for c in range(left[r], right[r] + 1):
            cell_mass = 0.0
            for i in range(q):
                mass[i, s] = field[i, r, c] / total
                cell_mass += mass[i, s]
                field[i, r, c] = 0
            cell[s] = r * columns + c
            s += cell_mass > LEAST_MASS
    return cell[:s].copy(), mass[:, :s].copy()


@njit(nogil=True, cache=True)
def _integrate_gaussian(
    moments: NDArray[np.float64],
    reach: float,
    field: NDArray[np.float32],
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    total: float,
) -> float:
    """Write a Gaussian's mass on each cell to `field`, (rows, columns); return `total` plus all of it.

    `left` and `right`, (rows,), the first and last column with mass in each row, are widened to include it.

    Notes
    -----
    The Gaussian is integrated over each row exactly. Within a row x is taken to be normal, with its mean and variance
    there, and integrated over the columns.
    """
    rows, columns = field.shape
    w = moments[0]
    x, y = moments[1] / w, moments[2] / w
    xx = max(moments[3] / w - x * x - CELL_VARIANCE, CELL_VARIANCE)
    yy = max(moments[5] / w - y * y - CELL_VARIANCE, CELL_VARIANCE)
    # keep the covariance positive definite
    limit = 0.99 * math.sqrt(xx * yy)
    xy = min(max(moments[4] / w - x * y, -limit), limit)
    slope = xy / yy
    conditional_xx = xx - slope * xy
    sigma = math.sqrt(yy)
    for r in range(max(int(y - reach * sigma), 0), min(int(y + reach * sigma) + 1, rows)):
        a, b = (r - y) / sigma, (r + 1 - y) / sigma
        share = 0.5 * (math.erf(b / math.sqrt(2.0)) - math.erf(a / math.sqrt(2.0)))
        if share < LEAST_MASS:
            continue
        pa = math.exp(-a * a / 2) / math.sqrt(2 * math.pi) / share
        pb = math.exp(-b * b / 2) / math.sqrt(2 * math.pi) / share
        inner_yy = min(max(yy * (1 + a * pa - b * pb - (pa - pb) ** 2), 0.0), CELL_VARIANCE)
        middle = x + slope * sigma * (pa - pb)
        width = math.sqrt(conditional_xx + slope * slope * inner_yy)
        start = max(int(middle - reach * width), 0)
        stop = min(int(middle + reach * width) + 1, columns)
        if start >= stop:
            continue
        before = math.erf((start - middle) / width / math.sqrt(2.0))
        for c in range(start, stop):
            after = math.erf((c + 1 - middle) / width / math.sqrt(2.0))
            cell_mass = w * share * 0.5 * (after - before)
            field[r, c] = cell_mass
            total += cell_mass
            before = after
        left[r], right[r] = min(left[r], start), max(right[r], stop - 1)
    return total
