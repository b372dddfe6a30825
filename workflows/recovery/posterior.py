"""The posterior mean of T about a first estimate: what the lobes of a pixel do not say, its measurements still may."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.footprint import NODES, fit_level, load, sample
from workflows.recovery.solvers import inner, subtract

# Standard deviation of the offset of a group, in units of T: S is known better than that.
_OFFSET = 0.03
# Conjugate gradients end when this share of the squared right-hand side is left.
_ENOUGH = 1e-5


@njit(nogil=True, cache=True)
def spread_lobes(
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    lobes: NDArray[np.float64],
    level: NDArray[np.int64],
    k: int,
    resolution: float,
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
) -> int:
    """Write the nodes under k lobes and their weights, which sum to 1.

    Parameters
    ----------
    columns, rows, starts
        Of the pyramid.
    lobes, level
        Changed: moved to the levels of the resolution.
    k : int
    resolution : float
        As in :func:`~workflows.recovery.footprint.fit_level`.
    node, weight : (k NODES,)
        Written; a node under two lobes is there twice.

    Returns
    -------
    int
        How many there are.
    """
    terms, n, total = np.empty((1, NODES), np.float32), 0, 0.0
    for i in range(k):
        total += lobes[i, 0]
    for i in range(k):
        level[i] = fit_level(lobes[i], level[i], columns, resolution)
        found = sample(lobes[i], level[i], columns, rows, starts, node[n:], terms)
        for j in range(found):
            weight[n + j] = terms[0, j] * lobes[i, 0] / total
        n += found
    return n


@njit(nogil=True, cache=True)
def rows_of(
    code: NDArray[np.uint8], first: int, groups: int, m: int, node: NDArray[np.int64], n: int
) -> NDArray[np.float32]:
    """(n, groups (m + 2)) float32: what the measurements of a pixel would be if all light came from a node."""
    A = np.empty((n, groups * (m + 2)), np.float32)
    for g in range(groups):
        to = g * (m + 2)
        load(code, first + g * m, m, node, n, A[:, to : to + m])
        for i in range(n):
            A[i, to + m], A[i, to + m + 1] = -1.0, 1.0
    return A


@njit(nogil=True, cache=True)
def unresolved(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    total: NDArray[np.float32],
) -> float:
    """kappa about a T of the given weights, and the variance of measurements for what is finer than its nodes.

    Parameters
    ----------
    A : (n, groups (m + 2)) float32
        As from :func:`rows_of`.
    weight : (n,) float32
    y, f, variance : (groups (m + 2),) float32
        Measurements, prediction with the offsets, the camera's variance.
    groups : int
    total : like y
        Written: the variance, and kappa times the share of the contrast that is within nodes.

    Returns
    -------
    float
        As from :func:`~workflows.recovery.mixture.weigh`, but of no parameters.
    """
    m = y.size // groups - 2
    mean, square = np.zeros_like(y), np.zeros_like(y)
    for i in range(A.shape[0]):
        row, w = A[i], weight[i]
        for j in range(y.size):
            mean[j] += w * row[j]
            square[j] += w * row[j] * row[j]
    excess, contrast = 0.0, 1e-9
    for j in range(y.size):
        if j % (m + 2) < m and variance[j] < np.inf:
            excess += (y[j] - f[j]) ** 2 - variance[j]
            contrast += max(1 - mean[j] ** 2, 0.02)
    kappa = min(max(excess / contrast, 1e-5), 1.0)
    for _ in range(4):
        excess, contrast = 0.0, 1e-9
        for j in range(y.size):
            if j % (m + 2) < m and variance[j] < np.inf:
                share = max(1 - mean[j] ** 2, 0.02)
                w = share / (variance[j] + kappa * share) ** 2
                excess += w * ((y[j] - f[j]) ** 2 - variance[j])
                contrast += w * share
        kappa = min(max(excess / contrast, 1e-5), 1.0)
    for j in range(y.size):
        total[j] = variance[j] + (kappa * max(1 - square[j], 0.0) if j % (m + 2) < m else 0.0)
    return kappa


@njit(nogil=True, cache=True)
def update(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    offset: NDArray[np.float64],
    passes: int,
    steps: int,
) -> tuple[float, float]:
    """Replace the weights of a T by their posterior mean given the measurements, again and again.

    Parameters
    ----------
    A : (n, groups (m + 2)) float32
        As from :func:`rows_of`.
    weight : (n,) float32
        Zero or more, of sum 1; changed.
    y, variance : (groups (m + 2),) float32
    groups : int
    offset : (groups,) float64
        Changed.
    passes : int
        Each starts from the weights that the one before left.
    steps : int
        Most conjugate gradients in a pass.

    Returns
    -------
    kappa : float
        As from :func:`unresolved`, before the last pass.
    misfit : float
        By how much the squared residuals of the patterns were larger than their variances then, in the mean. It is
        an estimate of the squared error of T times a pattern that it was not fitted to.

    Notes
    -----
    A priori T ~ N(t, kappa diag t): what a sample of 1 / kappa rays of t would be. With K = kappa A' diag(t) A + V, the
    posterior mean is ``t + kappa t * A K^-1 (y - A' t)``; negative weights are cut off. K is never built:
    ``K x = r`` is solved by conjugate gradients, of which the diagonal is the preconditioner.
    """
    n, M = A.shape
    m = M // groups - 2
    f, total, diagonal = np.empty_like(y), np.empty_like(y), np.empty_like(y)
    r, x, p, z, Kp = np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y)
    kappa, misfit = 0.0, 0.0
    for _ in range(passes):
        for j in range(M):
            f[j] = offset[j // (m + 2)]
        for i in range(n):
            subtract(f, -weight[i], A[i])
        kappa = unresolved(A, weight, y, f, variance, groups, total)
        misfit, used = 0.0, 0
        for j in range(M):
            if j % (m + 2) < m and variance[j] < np.inf:
                misfit += (y[j] - f[j]) ** 2 - variance[j]
                used += 1
        misfit /= max(used, 1)
        for j in range(M):
            diagonal[j] = total[j] + np.float32(_OFFSET**2)
        for i in range(n):
            row, s = A[i], np.float32(kappa) * weight[i]
            for j in range(M):
                diagonal[j] += s * row[j] * row[j]
        for j in range(M):
            # what was not measured stays as predicted
            r[j] = y[j] - f[j] if variance[j] < np.inf else 0.0
            total[j] = total[j] if variance[j] < np.inf else 0.0
            x[j], z[j] = 0.0, r[j] / diagonal[j]
            p[j] = z[j]
        left = inner(r, z)
        enough = left * np.float32(_ENOUGH)
        for _ in range(steps):
            if left <= enough:
                break
            for j in range(M):
                Kp[j] = total[j] * p[j]
            for g in range(groups):
                lean = np.float32(0)
                for j in range(g * (m + 2), (g + 1) * (m + 2)):
                    lean += p[j]
                for j in range(g * (m + 2), (g + 1) * (m + 2)):
                    Kp[j] += np.float32(_OFFSET**2) * lean
            for i in range(n):
                subtract(Kp, -np.float32(kappa) * weight[i] * inner(A[i], p), A[i])
            for j in range(M):
                Kp[j] = Kp[j] if variance[j] < np.inf else 0.0
            length = left / inner(p, Kp)
            subtract(x, -length, p)
            subtract(r, length, Kp)
            for j in range(M):
                z[j] = r[j] / diagonal[j]
            now = inner(r, z)
            for j in range(M):
                p[j] = z[j] + now / left * p[j]
            left = now
        for g in range(groups):
            for j in range(g * (m + 2), (g + 1) * (m + 2)):
                offset[g] += _OFFSET**2 * x[j]
        whole = 0.0
        for i in range(n):
            weight[i] *= max(1 + np.float32(kappa) * inner(A[i], x), np.float32(0))
            whole += weight[i]
        if whole > 0:
            for i in range(n):
                weight[i] /= np.float32(whole)
    return kappa, misfit
