"""The evidence for a T: how likely the measurements are, given its lobes as the prior's mean."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.posterior.covariance import write_stray_rows
from workflows.recovery.lobes.posterior.mean import add_row_moments, total_variance
from workflows.recovery.lobes.strays import write_strays
from workflows.recovery.solvers import inner


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def factorise(S: NDArray[np.float64]) -> None:
    """Replace the lower triangle of 1 plus a positive semidefinite matrix by its Cholesky factor."""
    for i in range(len(S)):
        for j in range(i + 1):
            left = S[i, j]
            for k in range(j):
                left -= S[i, k] * S[j, k]
            # what is left of the diagonal is at least that of the identity, whatever was rounded
            S[i, j] = left / S[j, j] if i > j else math.sqrt(max(left, 1.0))


@njit(nogil=True, cache=True)
def log_evidence(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    strays: NDArray[np.float32],
    stray: NDArray[np.float64],
) -> float:
    """-2 ln of the probability density of measurements, up to a constant that depends on `variance` < infinity alone.

    Parameters
    ----------
    A, weight, y, variance, strays, stray
        As in :func:`~workflows.recovery.lobes.posterior.mean.update`; none is changed.

    Returns
    -------
    float

    Notes
    -----
    With the prior and K of `update`, the measurements y are ``N(A' t, K)``, so this is ``r' K^-1 r + ln det K``, r the
    residual. The likelihood of the lobes alone takes what they cannot represent for noise. Here it may be light that
    the posterior mean finds, if it fits nodes that are there.

    With D the diagonal part of K, and U the rows of A times ``sqrt(kappa t)`` and those of stray light times their
    standard deviations, ``K = D + U'U``. The determinant of ``1 + X X'`` is that of ``1 + X' X``, X = U D^-1/2
    (Sylvester), and by the identity in `precondition` either gives ``r' K^-1 r``. The smaller one is factorised.
    """
    count, size = strays.shape
    n, groups = len(A), y.size // size
    f, mean, square, total = np.empty_like(y), np.zeros_like(y), np.zeros_like(y), np.empty_like(y)
    add_row_moments(A, weight, mean, square)
    write_strays(strays, stray, 0, f)
    for j in range(y.size):
        f[j] += mean[j]
    kappa, _ = total_variance(y, f, mean, square, variance, groups, total)
    scale, residual, found = np.zeros_like(y), np.zeros_like(y), 0.0
    for j in range(y.size):
        if variance[j] < np.inf:
            scale[j] = 1 / math.sqrt(total[j])
            residual[j] = (y[j] - f[j]) * scale[j]
            found += math.log(total[j]) + float(residual[j]) ** 2
    rows = np.empty((n + groups * count, y.size), np.float32)
    write_stray_rows(strays, rows[n:])
    for i in range(n):
        deviation = np.float32(math.sqrt(kappa * weight[i]))
        for j in range(y.size):
            rows[i, j] = deviation * A[i, j]
    for i in range(len(rows)):
        for j in range(y.size):
            rows[i, j] *= scale[j]
    by_nodes = len(rows) < y.size
    X = rows if by_nodes else np.ascontiguousarray(rows.T)
    S, b = np.empty((len(X), len(X))), np.empty(len(X))
    for i in range(len(X)):
        b[i] = inner(X[i], residual) if by_nodes else residual[i]
        for j in range(i + 1):
            S[i, j] = inner(X[i], X[j]) + (1.0 if i == j else 0.0)
    factorise(S)
    explained = 0.0
    for i in range(len(X)):
        for k in range(i):
            b[i] -= S[i, k] * b[k]
        b[i] /= S[i, i]
        explained += b[i] ** 2
        found += 2 * math.log(S[i, i])
    if by_nodes:
        return found - explained
    for j in range(y.size):
        found -= float(residual[j]) ** 2
    return found + explained
