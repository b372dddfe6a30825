"""The covariance of a pixel's measurements, and its solution by preconditioned conjugate gradients."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.strays import STRAY
from workflows.recovery.solvers import inner, subtract

# Prior standard deviation of the offset of a group, in units of T: an upper bound of the error of S.
_OFFSET = 0.03
# Conjugate gradients end when this fraction of the initial squared residual is left.
_PRECISION = 1e-5
# Where more than this fraction is left after the usual number of steps, they go on, up to this many times as many: so
# far from the solution, all weights may come out negative.
_UNSOLVED = 1e-2
_MOST_STEPS = 4


class Covariance(NamedTuple):
    """The covariance K of the measurements of a pixel, due to T, to stray light and to independent noise.

    Attributes
    ----------
    A : (n, groups (m + 2)) float32
        Responses of n nodes.
    weight : (n,) float32
        Their weights in T.
    kappa : float
        The covariance of T is kappa times the diagonal matrix of its weights.
    noise : (groups (m + 2),) float32
        Variance of the independent noise; 0 where nothing was measured.
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.lobes.footprint.PatternCodes`.
    measured : (groups (m + 2),) bool
    """

    A: NDArray[np.float32]
    weight: NDArray[np.float32]
    kappa: float
    noise: NDArray[np.float32]
    strays: NDArray[np.float32]
    measured: NDArray[np.bool_]


class Preconditioner(NamedTuple):
    """An approximate inverse of K, ``diag(inverse) - rows' rows``.

    Attributes
    ----------
    rows : (lobes + groups s, groups (m + 2)) float32
    inverse : (groups (m + 2),) float32
    factor : (lobes + groups s, lobes + groups s) float64
        Working space.
    ones : (lobes + groups s,) float32
        Ones.
    """

    rows: NDArray[np.float32]
    inverse: NDArray[np.float32]
    factor: NDArray[np.float64]
    ones: NDArray[np.float32]


class Steps(NamedTuple):
    """Working space of conjugate gradients, each (groups (m + 2),) float32.

    Attributes
    ----------
    r
        The residual.
    z
        The residual times the approximate inverse.
    p, Kp
        The direction of a step, and K times it.
    """

    r: NDArray[np.float32]
    z: NDArray[np.float32]
    p: NDArray[np.float32]
    Kp: NDArray[np.float32]


@njit(nogil=True, cache=True, inline="always")
def stray_variance(s: int) -> float:
    """Prior variance of an amount of stray light, by its row."""
    return _OFFSET**2 if s == 0 else STRAY**2


@njit(nogil=True, cache=True, inline="always")
def write_stray_rows(strays: NDArray[np.float32], rows: NDArray[np.float32]) -> None:
    """Write the stray light of each group times its prior standard deviation, (groups s, groups (m + 2))."""
    count, size = strays.shape
    rows[:] = 0
    for i in range(len(rows)):
        g, s = divmod(i, count)
        deviation = np.float32(math.sqrt(stray_variance(s)))
        for j in range(size):
            rows[i, g * size + j] = deviation * strays[s, j]


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
    # Four rows at a time, while they are in the processor's cache. Slices would be counted references.
    for i in range(0, n - 3, 4):
        a, b, c, d = np.uint64(i), np.uint64(i + 1), np.uint64(i + 2), np.uint64(i + 3)
        s, t, u, v = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for k in range(p.size):
            j = np.uint64(k)
            s += A[a, j] * p[j]
            t += A[b, j] * p[j]
            u += A[c, j] * p[j]
            v += A[d, j] * p[j]
        s *= scale * weight[a]
        t *= scale * weight[b]
        u *= scale * weight[c]
        v *= scale * weight[d]
        for k in range(p.size):
            j = np.uint64(k)
            out[j] += s * A[a, j] + t * A[b, j] + u * A[c, j] + v * A[d, j]
    for i in range(n - n % 4, n):
        a, s = np.uint64(i), np.float32(0)
        for k in range(p.size):
            s += A[a, np.uint64(k)] * p[np.uint64(k)]
        s *= scale * weight[a]
        for k in range(p.size):
            out[np.uint64(k)] += s * A[a, np.uint64(k)]


@njit(nogil=True, cache=True, error_model="numpy")
def precondition(
    K: Covariance,
    of_lobe: NDArray[np.float32],
    share: NDArray[np.float64],
    square: NDArray[np.float32],
    approximate: Preconditioner,
) -> None:
    """Write the approximate inverse of K.

    Parameters
    ----------
    K : Covariance
    of_lobe : (lobes, groups (m + 2)) float32
        Responses of the nodes of each lobe, weighted by T and summed.
    share : (lobes,) float64
        Sums of the weights of the nodes of each lobe.
    square : (groups (m + 2),) float32
        Squared responses of all nodes, weighted by T and summed.
    approximate : Preconditioner
        `rows`, `inverse` and `factor` are written.

    Notes
    -----
    The nodes of a lobe are neighbours and respond alike, so most of ``A' diag(t) A`` is ``sum_l w_l d_l d_l'``, d_l the
    mean response of a lobe of weight w_l. This is the matrix's projection on what is constant on each lobe, and the
    rest is positive. Of the rest the diagonal is kept: K is nearly ``D + U'U``, D diagonal, and U the rows
    ``sqrt(kappa w_l) d_l`` and those of stray light times their standard deviations. Both have the same diagonal.
    By the Woodbury identity (Hager, "Updating the inverse of a matrix", SIAM Review 1989)

        ``(D + U'U)^-1 = D^-1 - D^-1 U' (1 + U D^-1 U')^-1 U D^-1``,

    and with the Cholesky factor ``L L' = 1 + U D^-1 U'`` the rows kept are ``L^-1 U D^-1``.

    Without the rows, the light that all nodes of a lobe have in common made one eigenvalue for each lobe so large that
    conjugate gradients took 20 steps.
    """
    rows, inverse, factor, _ = approximate
    lobes, measurements = of_lobe.shape
    for j in range(measurements):
        within = np.float32(K.kappa) * square[j]
        for i in range(lobes):
            scale = np.float32(math.sqrt(K.kappa / share[i])) if share[i] > 0 else np.float32(0)
            rows[i, j] = scale * of_lobe[i, j]
            within -= rows[i, j] * rows[i, j]
        total = K.noise[j] + max(within, np.float32(0))
        inverse[j] = 1 / total if K.measured[j] else np.float32(0)
    write_stray_rows(K.strays, rows[lobes:])
    for i in range(len(rows)):
        for j in range(measurements):
            rows[i, j] *= math.sqrt(inverse[j])
    for i in range(len(rows)):
        for j in range(i + 1):
            left = float(inner(rows[i], rows[j]))
            for k in range(j):
                left -= factor[i, k] * factor[j, k]
            # what is left of the diagonal is at least that of the identity, whatever was rounded
            factor[i, j] = left / factor[j, j] if i > j else math.sqrt(max(left + 1, 1.0))
    for i in range(len(rows)):
        for k in range(i):
            subtract(rows[i], np.float32(factor[i, k]), rows[k])
        for j in range(measurements):
            rows[i, j] /= np.float32(factor[i, i])
    for i in range(len(rows)):
        for j in range(measurements):
            rows[i, j] *= math.sqrt(inverse[j])


@njit(nogil=True, cache=True, inline="always")
def apply_inverse(
    rows: NDArray[np.float32],
    inverse: NDArray[np.float32],
    ones: NDArray[np.float32],
    r: NDArray[np.float32],
    z: NDArray[np.float32],
) -> None:
    """Write the approximate inverse of K, from the fields of `Preconditioner`, times r to z."""
    for j in range(r.size):
        z[j] = inverse[j] * r[j]
    add_products(rows, np.float32(-1), ones, r, z)


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def add_stray_products(strays: NDArray[np.float32], p: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Add the covariance of the stray light times p to `out`."""
    count, size = strays.shape
    for start in range(0, p.size, size):
        for s in range(count):
            total = np.float32(0)
            for j in range(size):
                total += strays[s, j] * p[np.uint64(start + j)]
            total *= np.float32(stray_variance(s))
            for j in range(size):
                out[np.uint64(start + j)] += total * strays[s, j]


@njit(nogil=True, cache=True)
def solve_covariance(
    K: Covariance, approximate: Preconditioner, most: int, steps: Steps, x: NDArray[np.float32]
) -> int:
    """Solve ``K x = r`` by preconditioned conjugate gradients.

    Parameters
    ----------
    K : Covariance
    approximate : Preconditioner
    most : int
        Most steps; more are taken where most of the residual would be left.
    steps : Steps
        `r` is the right-hand side, and is overwritten with the residual; 0 where nothing was measured.
    x : (groups (m + 2),) float32
        Written.

    Returns
    -------
    int
        The number of steps.
    """
    # all at once: what is taken out of a tuple is counted as a reference
    (r, z, p, Kp), (rows, inverse, _, ones) = steps, approximate
    A, weight, kappa, noise, strays, measured = K
    apply_inverse(rows, inverse, ones, r, z)
    for j in range(r.size):
        x[j], p[j] = 0.0, z[j]
    left = inner(r, z)
    goal, far = left * np.float32(_PRECISION), left * np.float32(_UNSOLVED)
    taken = 0
    while taken < _MOST_STEPS * most and left > (goal if taken < most else far):
        for j in range(r.size):
            Kp[j] = noise[j] * p[j]
        add_stray_products(strays, p, Kp)
        add_products(A, np.float32(kappa), weight, p, Kp)
        for j in range(r.size):
            Kp[j] = Kp[j] if measured[j] else 0.0
        curvature = inner(p, Kp)
        if not curvature > 0:  # by rounding, where measurements have almost no noise
            break
        length = left / curvature
        subtract(x, -length, p)
        subtract(r, length, Kp)
        apply_inverse(rows, inverse, ones, r, z)
        new = inner(r, z)
        for j in range(r.size):
            p[j] = z[j] + new / left * p[j]
        left = new
        taken += 1
    return taken
