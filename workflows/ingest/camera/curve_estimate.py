"""Unknown curves of the camera and the monitor, estimated from what the camera saw of constant levels."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.images.tone_curves import Curve, Gamma, Response, to_light

PIXELS = 4096
"""About how many pixels curves are fitted to."""


class Estimate(NamedTuple):
    """The curves of monitor and camera; ``assumed`` names those that could not be estimated."""

    monitor: Curve
    camera: Curve
    assumed: tuple[str, ...]


def estimate(
    levels: NDArray[np.float32],
    exposures: NDArray[np.float32],
    values: NDArray[np.float32],
    usable: NDArray[np.bool_],
    monitor: Response,
    camera: Curve | Literal["unknown"],
) -> Estimate:
    """Estimate ``unknown`` curves from what the camera saw of constant levels.

    Parameters
    ----------
    levels : (k,) float32
        Grey values sent to the monitor, 0 to 1.
    exposures : (k,) float32
        Exposure times, in units of the shortest.
    values : (k, n) float32
        Values of n pixels for each level, 0 to 1.
    usable : (k, n) bool
        False where a value is clipped.
    monitor, camera : Curve or "unknown"
        As the capture states them, or as they were measured.

    Returns
    -------
    Estimate
        Known curves are returned as they are. The camera's is estimated from frames of one level with different
        exposures, or else from three levels of a known monitor; the monitor's from three levels seen by a camera with a
        known or estimated curve. A curve that can't be estimated is assumed to be sRGB, which nearly all monitors and
        cameras approximate.

    Notes
    -----
    Candidates are gammas from 0.4 to 4, sRGB and linear. The chosen one makes the light at the camera fit the model
    best: ``t (S + rho b)`` for the light b of the monitor (eq. 6), or ``t x`` for the exposures t of a level. A gamma
    must beat the named curves by 2 % of the squared error, because it has a free parameter.
    """
    some, step = usable.any(axis=1), max(1, values.shape[1] // PIXELS)
    levels, exposures = levels[some], exposures[some]
    values, usable = values[some, ::step], usable[some, ::step]
    enough = len(np.unique(levels)) >= 3 and _varies(values, usable)
    several = any(np.ptp(exposures[levels == level]) > 0 for level in np.unique(levels))
    assumed = []

    def off_line(b: NDArray[np.float32], c: NDArray[np.float32]) -> float:
        design = np.stack([exposures, exposures * b], axis=1)
        return _residual(design, c, usable) / _deviation(c, usable)

    def off_scale(c: NDArray[np.float32]) -> float:
        missed = spread = 0.0
        for level in np.unique(levels):
            at = levels == level
            # A single exposure says nothing about the curve.
            both = usable[at] & (usable[at].sum(axis=0) > 1)
            missed += _residual(exposures[at, np.newaxis], c[at], both)
            spread += _deviation(c[at], both)
        return missed / spread

    camera_curve: Curve = "srgb"
    if camera != "unknown":
        camera_curve = camera
    elif several and values.size:
        camera_curve = _closest(lambda curve: off_scale(to_light(values, curve)))
    elif monitor != "unknown" and enough:
        b = to_light(levels, monitor)
        camera_curve = _closest(lambda curve: off_line(b, to_light(values, curve)))
    else:
        assumed.append("camera")

    monitor_curve: Curve = "srgb"
    if monitor != "unknown":
        monitor_curve = monitor
    elif enough and not assumed:
        c = to_light(values, camera_curve)
        monitor_curve = _closest(lambda curve: off_line(to_light(levels, curve), c))
    else:
        assumed.append("monitor")
    return Estimate(monitor_curve, camera_curve, tuple(assumed))


def _varies(values: NDArray[np.float32], usable: NDArray[np.bool_]) -> bool:
    """Whether any pixel saw different values."""
    high, low = np.where(usable, values, -np.inf), np.where(usable, values, np.inf)
    return values.size > 0 and bool((high.max(axis=0) > low.min(axis=0)).any())


def _closest(misfit: Callable[[Curve], float]) -> Curve:
    from scipy.optimize import minimize_scalar  # takes half a second to import, and only calibration needs it

    best = minimize_scalar(lambda gamma: misfit(Gamma(gamma=gamma)), bounds=(0.4, 4.0), method="bounded")
    named: tuple[Curve, ...] = ("linear", "srgb")
    error, curve = min(((misfit(curve), curve) for curve in named), key=lambda pair: pair[0])
    return curve if error <= 1.02 * best.fun else Gamma(gamma=round(float(best.x), 4))


def _residual(design: NDArray[np.float32], c: NDArray[np.float32], usable: NDArray[np.bool_]) -> float:
    """Squared error of the least squares fit of each pixel's light, (k, n), by a design matrix, (k, d)."""
    weight, light, X = usable.T.astype(np.float64), c.T.astype(np.float64), design.astype(np.float64)
    gram = np.einsum("nk,ki,kj->nij", weight, X, X)
    slope = np.linalg.pinv(gram, hermitian=True) @ ((weight * light) @ X)[..., np.newaxis]
    return float(np.sum(weight * (light - slope[..., 0] @ X.T) ** 2))


def _deviation(c: NDArray[np.float32], usable: NDArray[np.bool_]) -> float:
    """Squared deviation of each pixel's light from its mean."""
    weight, light = usable.astype(np.float64), c.astype(np.float64)
    mean = (weight * light).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
    return float(max(np.sum(weight * (light - mean) ** 2), 1e-30))
