"""The likelihood of measurements given a prediction, and the penalty of a model's lobes.

The variance of a residual is the camera's plus kappa times the pattern's contrast within T. kappa, the part of T that
the prediction misses, is estimated from the residuals.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import PARAMETERS
from workflows.recovery.pyramid import Grids

# Least contrast of a pattern within T, 1 - f^2.
_LEAST_CONTRAST = 0.02
# Variances are multiplied until their product leaves this range, and then one logarithm is taken of all.
_SMALL, _LARGE = 1e-100, 1e100


# Without a branch for a division by zero or for what was not measured, the loop over the patterns is one of vectors.
@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def estimate_kappa(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    parameters: int,
    least: float,
) -> tuple[float, float]:
    """Estimate the variance of measurements that the prediction of T leaves unexplained.

    Parameters
    ----------
    y, f, variance : (groups (m + 2),) float32
        Measurements, prediction, and variances due to the camera; infinite where nothing was measured.
    mean : (groups (m + 2),) float32
        Prediction without offsets.
    groups : int
        Groups of measurements.
    parameters : int
        Number of fitted parameters.
    least : float
        Least value of kappa.

    Returns
    -------
    kappa : float
        Unexplained variance of a pattern of full contrast; 1 if T is a single ray that the prediction misses.
    misfit : float
        Mean of the patterns' squared residuals less their camera variances.

    Notes
    -----
    If T has the mean t and the covariance kappa diag(t), a pattern of +-1 has the additional variance
    kappa (1 - mean^2). kappa starts at its moment estimate and takes a few Fisher scoring steps.
    """
    size = y.size // groups
    kappa, misfit, freedom = 0.0, 0.0, 1.0
    for scoring in range(5):
        excess, contrast, used = 0.0, 1e-9, 0.0
        for g in range(groups):
            for i in range(size - 2):
                j = np.uint64(g * size + i)
                there = variance[j] < np.inf
                share = max(1 - mean[j] * mean[j], _LEAST_CONTRAST)
                weight = share / (variance[j] + kappa * share) ** 2 if scoring > 0 else 1.0
                excess += weight * (freedom * (y[j] - f[j]) ** 2 - variance[j]) if there else 0.0
                contrast += weight * share if there else 0.0
                used += 1.0 if there else 0.0
        kappa = min(max(excess / contrast, least), 1.0)
        if scoring == 0:
            misfit = excess / max(used, 1)
            freedom = used / max(used - parameters, used / 4, 1)
    return kappa, misfit


@njit(nogil=True, cache=True, error_model="numpy")
def weigh(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    parameters: int,
    precision: NDArray[np.float32],
) -> tuple[float, float]:
    """Compute the precisions of measurements given a prediction, and the likelihood.

    Parameters
    ----------
    y, f, variance, groups, parameters
        As in :func:`estimate_kappa`.
    precision : (groups (m + 2),) float32
        Written: inverse of the camera's variance plus the unexplained one.

    Returns
    -------
    kappa : float
        As from :func:`estimate_kappa`.
    objective : float
        -2 ln likelihood, up to a constant.
    """
    m = y.size // groups - 2
    kappa, _ = estimate_kappa(y, f, f, variance, groups, parameters, 0.0)
    objective, product = 0.0, 1.0
    for g in range(groups):
        for j in range(g * (m + 2), (g + 1) * (m + 2)):
            share = max(1 - f[j] * f[j], _LEAST_CONTRAST) if j < g * (m + 2) + m else 0.0
            total = variance[j] + kappa * share
            precision[j] = 1 / total
            if total < np.inf:
                objective += (y[j] - f[j]) ** 2 / total
                product *= total
                if not _SMALL < product < _LARGE:
                    objective += math.log(product)
                    product = 1.0
    return kappa, objective + math.log(product)


@njit(nogil=True, cache=True)
def penalty(grids: Grids, level: NDArray[np.int64], k: int) -> float:
    """Penalty of k lobes in -2 ln likelihood: 2 per weight and shape parameter, 2 ln(nodes of the level) per centre."""
    total = 0.0
    for i in range(k):
        total += 2 * (PARAMETERS - 2) + 2 * math.log(grids.columns[level[i]] * grids.rows[level[i]])
    return total
