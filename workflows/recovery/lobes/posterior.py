"""The posterior mean of T given the measurements, with the lobes as the prior's mean."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.likelihood import estimate_kappa
from workflows.recovery.lobes.strays import STRAY, write_strays
from workflows.recovery.solvers import inner, subtract

# Prior standard deviation of the offset of a group, in units of T: an upper bound of the error of S.
_OFFSET = 0.03
# Conjugate gradients end when this fraction of the initial squared residual is left.
_PRECISION = 1e-5
# Where more than this fraction is left after the usual number of steps, they go on, up to this many times as many: so
# far from the solution, all weights may come out negative.
_UNSOLVED = 1e-2
_MOST_STEPS = 4
_LEAST_KAPPA = 1e-5


@njit(nogil=True, cache=True, inline="always")
def stray_variance(s: int) -> float:
    """Prior variance of an amount of stray light, by its row."""
    return _OFFSET**2 if s == 0 else STRAY**2


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def add_row_moments(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
) -> None:
    """Add the weighted sums of the rows of A, and of their squares, to `mean` and `square`."""
    n = A.shape[0]
    # two rows at a time, so that the sums are read and written half as often
    for i in range(0, n - 1, 2):
        a, b, v, w = A[i], A[i + 1], weight[i], weight[i + 1]
        for j in range(mean.size):
            mean[j] += v * a[j] + w * b[j]
            square[j] += v * a[j] * a[j] + w * b[j] * b[j]
    if n % 2:
        a, v = A[n - 1], weight[n - 1]
        for j in range(mean.size):
            mean[j] += v * a[j]
            square[j] += v * a[j] * a[j]


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def add_products(
    A: NDArray[np.float32],
    scale: np.float32,
    weight: NDArray[np.float32],
    p: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Add ``scale A' diag(weight) A p`` to `out`."""
    n = A.shape[0]
    # four rows at a time, while they are in the processor's cache
    for i in range(0, n - 3, 4):
        a, b, c, d = A[i], A[i + 1], A[i + 2], A[i + 3]
        s, t, u, v = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for j in range(p.size):
            s += a[j] * p[j]
            t += b[j] * p[j]
            u += c[j] * p[j]
            v += d[j] * p[j]
        s *= scale * weight[i]
        t *= scale * weight[i + 1]
        u *= scale * weight[i + 2]
        v *= scale * weight[i + 3]
        for j in range(p.size):
            out[j] += s * a[j] + t * b[j] + u * c[j] + v * d[j]
    for i in range(n - n % 4, n):
        subtract(out, -scale * weight[i] * inner(A[i], p), A[i])


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
def apply_covariance(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    kappa: float,
    total: NDArray[np.float32],
    strays: NDArray[np.float32],
    measured: NDArray[np.bool_],
    p: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write K p, K the covariance of the measurements due to T, to stray light, and to independent noise (`total`)."""
    count, size = strays.shape
    for j in range(p.size):
        out[j] = total[j] * p[j]
    for g in range(p.size // size):
        of_group, to = p[g * size : (g + 1) * size], out[g * size : (g + 1) * size]
        for s in range(count):
            subtract(to, -np.float32(stray_variance(s)) * inner(strays[s], of_group), strays[s])
    add_products(A, np.float32(kappa), weight, p, out)
    for j in range(p.size):
        out[j] = out[j] if measured[j] else 0.0


@njit(nogil=True, cache=True, inline="always")
def solve_covariance(
    A: NDArray[np.float32],
    weight: NDArray[np.float32],
    kappa: float,
    total: NDArray[np.float32],
    diagonal: NDArray[np.float32],
    strays: NDArray[np.float32],
    measured: NDArray[np.bool_],
    r: NDArray[np.float32],
    steps: int,
    x: NDArray[np.float32],
) -> None:
    """Solve ``K x = r`` by conjugate gradients, preconditioned by the diagonal of K; r is overwritten."""
    z, p, Kp = np.empty_like(r), np.empty_like(r), np.empty_like(r)
    for j in range(r.size):
        x[j], z[j] = 0.0, r[j] / diagonal[j]
        p[j] = z[j]
    left = inner(r, z)
    goal, far = left * np.float32(_PRECISION), left * np.float32(_UNSOLVED)
    for step in range(_MOST_STEPS * steps):
        if left <= (goal if step < steps else far):
            break
        apply_covariance(A, weight, kappa, total, strays, measured, p, Kp)
        length = left / inner(p, Kp)
        subtract(x, -length, p)
        subtract(r, length, Kp)
        for j in range(r.size):
            z[j] = r[j] / diagonal[j]
        new = inner(r, z)
        for j in range(r.size):
            p[j] = z[j] + new / left * p[j]
        left = new


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
    y: NDArray[np.float32],
    variance: NDArray[np.float32],
    strays: NDArray[np.float32],
    stray: NDArray[np.float64],
    passes: int,
    steps: int,
) -> tuple[float, float]:
    """Replace the weights of a T by their posterior mean given the measurements, several times in succession.

    Parameters
    ----------
    A : (n, groups (m + 2)) float32
        Responses of n nodes, as from :func:`~workflows.recovery.lobes.nodes.node_responses`.
    weight : (n,) float32
        Zero or more, of sum 1; changed in place.
    y, variance : (groups (m + 2),) float32
        Measurements, and their variances due to the camera; infinite where nothing was measured.
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.lobes.footprint.PatternCodes`.
    stray : (groups s or more,) float64
        The amounts of stray light, changed in place.
    passes : int
        Number of updates; each starts from the weights of the one before.
    steps : int
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
    groups = y.size // size
    f, total, diagonal, r, x = (
        np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y)
    )  # fmt: skip
    mean, square, measured = np.empty_like(y), np.empty_like(y), variance < np.inf
    kappa, misfit = 0.0, 0.0
    for _ in range(passes):
        mean[:], square[:] = 0, 0
        add_row_moments(A, weight, mean, square)
        write_strays(strays, stray, 0, f)
        for j in range(y.size):
            f[j] += mean[j]
        kappa, misfit = total_variance(y, f, mean, square, variance, groups, total)
        for j in range(y.size):
            diagonal[j] = total[j] + np.float32(kappa) * square[j]
            for s in range(count):
                diagonal[j] += np.float32(stray_variance(s)) * strays[s, j % size] ** 2
            # where nothing was measured the residual is 0
            r[j] = y[j] - f[j] if measured[j] else 0.0
            total[j] = total[j] if measured[j] else 0.0
        solve_covariance(A, weight, kappa, total, diagonal, strays, measured, r, steps, x)
        for g in range(groups):
            for s in range(count):
                stray[g * count + s] += stray_variance(s) * inner(strays[s], x[g * size : (g + 1) * size])
        reweight(A, kappa, x, weight)
    return kappa, misfit
