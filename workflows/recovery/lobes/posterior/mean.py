"""The posterior mean of T given the measurements, with the lobes as the prior's mean."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.likelihood import estimate_kappa
from workflows.recovery.lobes.posterior.covariance import (
    Covariance,
    Preconditioner,
    Steps,
    precondition,
    solve_covariance,
    stray_variance,
)
from workflows.recovery.lobes.strays import write_strays
from workflows.recovery.solvers import inner

_LEAST_KAPPA = 1e-5


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def add_row_moments(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
) -> None:
    """Add the weighted sums of the rows of A, and of their squares, to `mean` and `square`."""
    n = A.shape[0]
    # Two rows at a time, so that the sums are read and written half as often. Slices would be counted references.
    for i in range(0, n - 1, 2):
        a, b, v, w = np.uint64(i), np.uint64(i + 1), weight[i], weight[i + 1]
        for k in range(mean.size):
            j = np.uint64(k)
            mean[j] += v * A[a, j] + w * A[b, j]
            square[j] += v * A[a, j] * A[a, j] + w * A[b, j] * A[b, j]
    if n % 2:
        a, v = np.uint64(n - 1), weight[n - 1]
        for k in range(mean.size):
            j = np.uint64(k)
            mean[j] += v * A[a, j]
            square[j] += v * A[a, j] * A[a, j]


@njit(nogil=True, cache=True)
def total_variance(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    total: NDArray[np.float32],
) -> tuple[float, float]:
    """Estimate kappa about a T, and the variance of measurements due to the camera and to light finer than T's nodes.

    Parameters
    ----------
    y, f : (groups (m + 2),) float32
        Measurements, and their prediction with the offsets.
    mean, square : (groups (m + 2),) float32
        Means of the nodes' responses and of their squares, weighted by T.
    variance : (groups (m + 2),) float32
        The camera's variance.
    groups : int
    total : (groups (m + 2),) float32
        Written: the camera's variance plus kappa times the contrast within nodes.

    Returns
    -------
    kappa, misfit : float
        As from :func:`~workflows.recovery.lobes.likelihood.estimate_kappa`.
    """
    m = y.size // groups - 2
    # with a literal, numba would compile another version of `estimate_kappa`
    parameters = np.int64(0)
    kappa, misfit = estimate_kappa(y, f, mean, variance, groups, parameters, _LEAST_KAPPA)
    for g in range(groups):
        for j in range(g * (m + 2), (g + 1) * (m + 2)):
            within = kappa * max(1 - square[j], 0.0) if j < g * (m + 2) + m else 0.0
            total[j] = variance[j] + within
    return kappa, misfit


@njit(nogil=True, cache=True, inline="always")
def reweight(
    A: NDArray[np.float32], kappa: float, x: NDArray[np.float32], weight: NDArray[np.float32]
) -> None:
    """Multiply the weights by ``1 + kappa A x``, clipped at 0, and normalise their sum to 1.

    They stay as they are if all would be 0.
    """
    factor, total = np.empty_like(weight), 0.0
    for i in range(weight.size):
        factor[i] = max(1 + np.float32(kappa) * inner(A[i], x), np.float32(0))
        total += weight[i] * factor[i]
    if total > 0:
        for i in range(weight.size):
            weight[i] *= factor[i] / np.float32(total)


@njit(nogil=True, cache=True)
def update(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    end: NDArray[np.int64],
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    strays: NDArray[np.float32],
    stray: NDArray[np.float64],
    passes: int,
    most: int,
) -> tuple[float, float]:
    """Replace the weights of a T by their posterior mean given the measurements, several times in succession.

    Parameters
    ----------
    A : (n, groups (m + 2)) float32
        Responses of n nodes, as from :func:`~workflows.recovery.lobes.nodes.node_responses`.
    weight : (n,) float32
        Zero or more, of sum 1; changed in place.
    end : (lobes,) int64
        Where the nodes of each lobe end, as from :func:`~workflows.recovery.lobes.nodes.spread_lobes`.
    y, variance : (groups (m + 2),) float32
        Measurements, and their variances due to the camera; infinite where nothing was measured.
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.lobes.footprint.PatternCodes`.
    stray : (groups s or more,) float64
        The amounts of stray light, changed in place.
    passes : int
        Number of updates; each starts from the weights of the one before.
    most : int
        Most conjugate gradient steps in a pass.

    Returns
    -------
    kappa, misfit : float
        As from :func:`total_variance`, before the last update. The misfit estimates the squared error of predictions
        of patterns that T was not fitted to.

    Notes
    -----
    The prior is T ~ N(t, kappa diag t), as of a sample of 1 / kappa rays from t. With K = kappa A' diag(t) A + V, the
    posterior mean is ``t + kappa t * A K^-1 (y - A' t)``; negative weights are set to 0. K is never built:
    ``K x = r`` is solved by conjugate gradients.
    """
    count, size = strays.shape
    groups, lobes = y.size // size, end.size
    f, noise, x = np.empty_like(y), np.empty_like(y), np.empty_like(y)
    mean, square, measured = np.empty_like(y), np.empty_like(y), variance < np.inf
    of_lobe, share = np.empty((lobes, y.size), np.float32), np.empty(lobes)
    rank = lobes + groups * count
    approximate = Preconditioner(
        np.empty((rank, y.size), np.float32),
        np.empty_like(y),
        np.empty((rank, rank)),
        np.ones(rank, np.float32),
    )
    steps = Steps(np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y))
    kappa, misfit = 0.0, 0.0
    for _ in range(passes):
        mean[:], square[:], of_lobe[:], share[:] = 0, 0, 0, 0
        begin = 0
        for i in range(lobes):
            add_row_moments(A[begin : end[i]], weight[begin : end[i]], of_lobe[i], square)
            for j in range(begin, end[i]):
                share[i] += weight[j]
            for j in range(y.size):
                mean[j] += of_lobe[i, j]
            begin = end[i]
        write_strays(strays, stray, 0, f)
        for j in range(y.size):
            f[j] += mean[j]
        kappa, misfit = total_variance(y, f, mean, square, variance, groups, noise)
        for j in range(y.size):
            # where nothing was measured the residual is 0
            steps.r[j] = y[j] - f[j] if measured[j] else 0.0
            noise[j] = noise[j] if measured[j] else 0.0
        K = Covariance(A, weight, kappa, noise, strays, measured)
        precondition(K, of_lobe, share, square, approximate)
        solve_covariance(K, approximate, most, steps, x)
        for g in range(groups):
            for s in range(count):
                stray[g * count + s] += stray_variance(s) * inner(strays[s], x[g * size : (g + 1) * size])
        reweight(A, kappa, x, weight)
    return kappa, misfit
