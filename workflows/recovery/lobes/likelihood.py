"""How likely measurements are before what is predicted of them, and what lobes must be worth to stay.

A prediction leaves some of T out; how much, its residuals say: kappa.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import PARAMETERS
from workflows.recovery.pyramid import Grids

# A pattern's contrast within T is never quite zero.
_LEAST_CONTRAST = 0.02


@njit(nogil=True, cache=True)
def scatter(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    mean: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    parameters: int,
    least: float,
) -> tuple[float, float]:
    """How far T is from what predicts the measurements.

    Parameters
    ----------
    y, f, variance : (groups (m + 2),) float32
        Measurements, prediction, and the camera's share of their variances; infinite for no measurement.
    mean : like y
        What the prediction makes of the patterns, without offsets.
    groups, parameters : int
        Parameters that were fitted.
    least : float
        The least kappa.

    Returns
    -------
    kappa : float
        Variance that a pattern of full contrast has because T is not the prediction's; 1 if T is a single ray.
    misfit : float
        By how much the squared residuals of the patterns are larger than their variances, in the mean.

    Notes
    -----
    A T of mean t and covariance kappa diag(t) adds the variance kappa (1 - mean^2) to a pattern of +-1. kappa is
    found by a few scoring steps from its moment estimate.
    """
    m = y.size // groups - 2
    kappa, misfit, freedom = 0.0, 0.0, 1.0
    for scoring in range(5):
        excess, contrast, used = 0.0, 1e-9, 0
        for g in range(groups):
            for j in range(g * (m + 2), g * (m + 2) + m):
                if variance[j] < np.inf:
                    share = max(1 - mean[j] * mean[j], _LEAST_CONTRAST)
                    weight = share / (variance[j] + kappa * share) ** 2 if scoring > 0 else 1.0
                    excess += weight * (freedom * (y[j] - f[j]) ** 2 - variance[j])
                    contrast += weight * share
                    used += 1
        kappa = min(max(excess / contrast, least), 1.0)
        if scoring == 0:
            misfit = excess / max(used, 1)
            freedom = used / max(used - parameters, used / 4, 1)
    return kappa, misfit


@njit(nogil=True, cache=True)
def weigh(
    y: NDArray[np.float32],
    f: NDArray[np.float32],
    variance: NDArray[np.float32],
    groups: int,
    parameters: int,
    precision: NDArray[np.float32],
) -> tuple[float, float]:
    """The precision of measurements whose prediction leaves some of T out.

    Parameters
    ----------
    y, f, variance : (groups (m + 2),) float32
        Measurements, prediction, and the camera's share of their variances; infinite for no measurement.
    groups, parameters : int
        Parameters that were fitted.
    precision : like y
        Written.

    Returns
    -------
    kappa : float
        As from :func:`scatter`.
    objective : float
        -2 ln likelihood, up to a constant.
    """
    m = y.size // groups - 2
    kappa, _ = scatter(y, f, f, variance, groups, parameters, 0.0)
    objective = 0.0
    for g in range(groups):
        for j in range(g * (m + 2), (g + 1) * (m + 2)):
            share = max(1 - f[j] * f[j], _LEAST_CONTRAST) if j < g * (m + 2) + m else 0.0
            total = variance[j] + kappa * share
            precision[j] = 1 / total
            if total < np.inf:
                objective += (y[j] - f[j]) ** 2 / total + math.log(total)
    return kappa, objective


@njit(nogil=True, cache=True)
def price(grids: Grids, level: NDArray[np.int64], k: int) -> float:
    """What k lobes must be worth in -2 ln likelihood: 2 for each shape and weight, and their places among all."""
    cost = 0.0
    for i in range(k):
        cost += 2 * (PARAMETERS - 2) + 2 * math.log(grids.columns[level[i]] * grids.rows[level[i]])
    return cost
