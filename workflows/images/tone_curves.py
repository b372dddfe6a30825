"""Tone curves: between the value sent to a monitor, or stored by a camera, and linear light."""

from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field


class Gamma(BaseModel):
    """A pure power law: light = value ** gamma."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    gamma: Annotated[float, Field(ge=0.2, le=5.0, description="The exponent.", examples=[2.2])]


# Pixels, about, that curves are fitted to.
_SAMPLE = 4096

Curve = Literal["linear", "srgb"] | Gamma
Response = Literal["linear", "srgb", "unknown"] | Gamma


class Estimate(NamedTuple):
    """Curves of monitor and camera, and which of them, ``monitor`` or ``camera``, are only assumed."""

    monitor: Curve
    camera: Curve
    assumed: tuple[str, ...]


BLACK = 4096
"""What no light is stored as where float values are stored as uint16: noise goes below it."""


def to_light(values: NDArray[np.float32], curve: Curve) -> NDArray[np.float32]:
    """Linear light of encoded values.

    Parameters
    ----------
    values : (...) float32
        0 to 1.
    curve : Curve
        ``srgb`` is the piecewise curve of IEC 61966-2-1.

    Returns
    -------
    (...) float32
        0 to 1.
    """
    if curve == "linear":
        return values
    if curve == "srgb":
        low = values / np.float32(12.92)
        high = ((np.maximum(values, 0) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
        return np.where(values <= 0.04045, low, high)
    return np.maximum(values, 0) ** np.float32(curve.gamma)


def from_light(light: NDArray[np.float32], curve: Literal["linear", "srgb"]) -> NDArray[np.float32]:
    """Encoded values of linear light, the inverse of `to_light`."""
    if curve == "linear":
        return light
    low = light * np.float32(12.92)
    high = np.float32(1.055) * np.maximum(light, 0) ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(light <= 0.0031308, low, high)


def table(curve: Curve, dtype: np.dtype[np.unsignedinteger], black: int = 0) -> NDArray[np.float32]:
    """Light of every value of an unsigned integer type: turns a stack of frames to light by one look-up.

    ``black`` is the value of no light; what is below it is negative.
    """
    top = np.iinfo(dtype).max
    return to_light((np.arange(top + 1, dtype=np.float32) - black) / np.float32(top - black), curve)


def estimate(
    levels: NDArray[np.float32],
    exposures: NDArray[np.float32],
    values: NDArray[np.float32],
    usable: NDArray[np.bool_],
    monitor: Response,
    camera: Response,
) -> Estimate:
    """Curves in place of ``unknown`` ones, from what the camera saw of constant levels.

    Parameters
    ----------
    levels : (k,) float32
        Grey values sent to the monitor, 0 to 1.
    exposures : (k,) float32
        For how long the camera saw each, in units of the shortest.
    values : (k, n) float32
        What n pixels stored for each, 0 to 1.
    usable : (k, n) bool
        False where a value is clipped.
    monitor, camera : Response
        As the capture says.

    Returns
    -------
    Estimate
        Known curves as they are. The camera's is told by frames of one level with different exposures, else by three
        levels of a known monitor; the monitor's by three levels before a camera whose curve is known or
        told. What can't be told is taken for sRGB, which is what nearly every monitor and camera is built to.

    Notes
    -----
    Of the gammas from 0.4 to 4, sRGB and no curve, that is taken under which the light at the camera is
    closest to the model: ``t (S + rho b)`` in the light b of the monitor (eq. 6), or ``t x`` in the exposures t of a
    level. A gamma must beat the named curves by 2 % of the squared error, for it has a value to choose.
    """
    some, step = usable.any(axis=1), max(1, values.shape[1] // _SAMPLE)
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
            # one exposure alone says nothing of the curve
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
    """Whether some pixel saw a difference."""
    high, low = np.where(usable, values, -np.inf), np.where(usable, values, np.inf)
    return values.size > 0 and bool((high.max(axis=0) > low.min(axis=0)).any())


def _closest(misfit: Callable[[Curve], float]) -> Curve:
    from scipy.optimize import minimize_scalar  # half a second to import, and who composites never comes here

    best = minimize_scalar(lambda gamma: misfit(Gamma(gamma=gamma)), bounds=(0.4, 4.0), method="bounded")
    named: tuple[Curve, ...] = ("linear", "srgb")
    error, curve = min(((misfit(curve), curve) for curve in named), key=lambda pair: pair[0])
    return curve if error <= 1.02 * best.fun else Gamma(gamma=round(float(best.x), 4))


def _residual(design: NDArray[np.float32], c: NDArray[np.float32], usable: NDArray[np.bool_]) -> float:
    """Squared error of each pixel's light (k, n) where it is best fitted by the columns of the design (k, d)."""
    weight, light, X = usable.T.astype(np.float64), c.T.astype(np.float64), design.astype(np.float64)
    gram = np.einsum("nk,ki,kj->nij", weight, X, X)
    slope = np.linalg.pinv(gram, hermitian=True) @ ((weight * light) @ X)[..., np.newaxis]
    return float(np.sum(weight * (light - slope[..., 0] @ X.T) ** 2))


def _deviation(c: NDArray[np.float32], usable: NDArray[np.bool_]) -> float:
    """Squared deviation of each pixel's light from its mean."""
    weight, light = usable.astype(np.float64), c.astype(np.float64)
    mean = (weight * light).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
    return float(max(np.sum(weight * (light - mean) ** 2), 1e-30))
