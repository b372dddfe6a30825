"""Kernels for least squares on the few cells of one pixel, shared by both methods.

Matrices have one row per cell and one column per measurement, so that inner loops run over contiguous memory.

Kernels that several others call are declared with their types, so that they are compiled when their module is imported.
If they were compiled at their first call, they would be optimised together with that caller, and the last bits of both
methods' sums would depend on which method ran first on a machine.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray


# "reassoc" allows vector instructions. The order of the sum depends on the length and the machine's vector width only,
# not on memory alignment or the batch.
@njit("float32(float32[::1], float32[::1])", nogil=True, cache=True, fastmath={"reassoc"})
def inner(a: NDArray[np.float32], b: NDArray[np.float32]) -> np.float32:
    """Inner product of two float32 vectors of equal length."""
    total = np.float32(0)
    for k in range(a.size):
        total += a[k] * b[k]
    return total


@njit("void(float32[::1], float32, float32[::1])", nogil=True, cache=True)
def subtract(residual: NDArray[np.float32], factor: np.float32, row: NDArray[np.float32]) -> None:
    """Subtract ``factor * row`` from `residual`, in place."""
    for k in range(residual.size):
        residual[k] -= factor * row[k]


@njit(nogil=True, cache=True)
def solve_nnls(
    matrix: NDArray[np.float32],
    target: NDArray[np.float32],
    x: NDArray[np.float32],
    sweeps: int,
    tolerance: float,
) -> NDArray[np.float32]:
    """Minimise ``|target - x matrix|^2`` over x >= 0 by cyclic coordinate descent, from the given x.

    Parameters
    ----------
    matrix : (s, m) float32
        One row per cell.
    target : (m,) float32
        Measurements.
    x : (s,) float32
        Initial value, zero or more; overwritten with the result.
    sweeps : int
        Most sweeps over the cells. Every fourth, and the one that confirms convergence, includes the cells at zero.
    tolerance : float
        Sweeps end when one changes no entry by more than this.

    Returns
    -------
    (m,) float32
        The residual ``target - x matrix``.

    Notes
    -----
    ``x_j <- max(0, x_j + a_j . r / a_j . a_j)``, with the residual r kept up to date.
    """
    s = x.size
    residual = target.copy()
    energy = np.empty(s, np.float32)
    for j in range(s):
        energy[j] = inner(matrix[j], matrix[j])
        if x[j] > 0:
            subtract(residual, x[j], matrix[j])
    converged = False
    for sweep in range(sweeps):
        all_cells = converged or sweep % 4 == 0
        largest = np.float32(0)
        for j in range(s):
            if energy[j] > 0 and (all_cells or x[j] > 0):
                new = max(x[j] + inner(matrix[j], residual) / energy[j], np.float32(0))
                change = new - x[j]
                if change != 0:
                    subtract(residual, change, matrix[j])
                    x[j] = new
                    largest = max(largest, abs(change))
        converged = bool(largest <= tolerance)
        if converged and all_cells:
            break
    return residual


@njit(nogil=True, cache=True)
def posterior_mean(
    matrix: NDArray[np.float32],
    residual: NDArray[np.float32],
    mean: NDArray[np.float32],
    variance: float,
    prior_scale: float,
    steps: int,
    precision: float,
) -> NDArray[np.float32]:
    """Posterior mean of t given measurements and the prior ``t ~ N(mean, prior_scale * diag(mean))``, clipped at zero.

    Parameters
    ----------
    matrix : (s, n) float32
        One row per cell.
    residual : (n,) float32
        Measurements less ``mean matrix``.
    mean : (s,) float32
        Prior mean, zero or more.
    variance : float
        Variance of the measurements, zero or more.
    prior_scale : float
        Prior variance per unit of the mean; the prior mean is returned if it is not positive.
    steps : int
        Most conjugate gradient steps.
    precision : float
        Steps end when the residual's norm is this fraction of the right-hand side's.

    Returns
    -------
    (s,) float32

    Notes
    -----
    Conjugate gradients on ``(A M A' + variance / prior_scale) y = residual``, then ``t = mean + M A' y``. A is the
    transpose of `matrix`, and M = diag(mean).
    """
    s, n = matrix.shape
    t = mean.copy()
    if prior_scale <= 0:
        return t
    ridge = np.float32(variance / prior_scale)
    y = np.zeros(n, np.float32)
    left, direction, image = residual.copy(), residual.copy(), np.empty(n, np.float32)
    energy = inner(left, left)
    goal = np.float32(precision * precision) * energy
    for _ in range(steps):
        if energy <= goal:
            break
        for k in range(n):
            image[k] = ridge * direction[k]
        for j in range(s):
            subtract(image, -mean[j] * inner(matrix[j], direction), matrix[j])
        curvature = inner(direction, image)
        if curvature <= 0:
            break
        step = energy / curvature
        for k in range(n):
            y[k] += step * direction[k]
            left[k] -= step * image[k]
        new = inner(left, left)
        for k in range(n):
            direction[k] = left[k] + new / energy * direction[k]
        energy = new
    for j in range(s):
        t[j] = max(t[j] + mean[j] * inner(matrix[j], y), np.float32(0))
    return t


@njit("void(float32[:, ::1], int32[::1], float32[::1], int64, float32[:, ::1])", nogil=True, cache=True)
def signed_rows(
    light: NDArray[np.float32],
    cell: NDArray[np.int32],
    scale: NDArray[np.float32],
    first: int,
    out: NDArray[np.float32],
) -> None:
    """Write the light of cells in +-1 form, each measurement scaled.

    Parameters
    ----------
    light : (cells, m) float32
        Light of one channel, 0 (black) to 1 (white), as in :class:`~workflows.recovery.sensing.Level`.
    cell : (s,) int32
        Cells.
    scale : (m,) float32
        Factor of each measurement.
    first : int
        Column of `out` for the first measurement.
    out : (s, first + m or more) float32
        Written from that column on: ``scale * (2 light[cell] - 1)``.
    """
    for i in range(cell.size):
        row, written = light[cell[i]], out[i, first : first + scale.size]
        for k in range(scale.size):
            written[k] = scale[k] * (2 * row[k] - 1)


@njit("void(float32[:, :, ::1], int32[::1], float32[::1], float32[:, ::1])", nogil=True, cache=True)
def stack_rows(
    light: NDArray[np.float32],
    cell: NDArray[np.int32],
    scale: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Write :func:`signed_rows` of several channels, one after another.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the channels, 0 (black) to 1 (white).
    cell : (s,) int32
        Cells.
    scale : (channels * m,) float32
        Factor of each measurement.
    out : (s, channels * m) float32
        Written.
    """
    m = light.shape[2]
    for c in range(light.shape[0]):
        signed_rows(light[c], cell, scale[c * m : (c + 1) * m], c * m, out)
