"""Tone curves: between the value sent to a monitor, or stored by a camera, and linear light."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.optimize import minimize_scalar


class Gamma(BaseModel):
    """A pure power: light = value ** gamma."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    gamma: Annotated[float, Field(ge=0.2, le=5.0)]


Curve = Literal["linear", "srgb"] | Gamma
Response = Literal["linear", "srgb", "unknown"] | Gamma


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


def table(curve: Curve, dtype: np.dtype[np.unsignedinteger]) -> NDArray[np.float32]:
    """Light of every value of an unsigned integer type: turns a stack of frames to light by one look-up."""
    top = np.iinfo(dtype).max
    return to_light(np.arange(top + 1, dtype=np.float32) / np.float32(top), curve)


def estimate(
    levels: NDArray[np.float32], values: NDArray[np.float32], monitor: Response, camera: Response
) -> tuple[Curve, Curve]:
    """Curves in place of ``unknown`` ones, from what the camera saw of constant levels.

    Parameters
    ----------
    levels : (k,) float32
        Grey values sent to the monitor, 0 to 1.
    values : (k, n) float32
        What n pixels stored for each, 0 to 1, none of them clipped.
    monitor, camera : Response
        As the capture says.

    Returns
    -------
    monitor, camera : Curve
        Known curves as they are. One unknown curve is the gamma under which the light at the camera is
        closest to a line in the light of the monitor (eq. 6). With both unknown, fewer than three levels,
        or a camera that saw no difference, the levels can't tell, and an unknown curve is taken for sRGB,
        which is what nearly every monitor and camera is built to.
    """

    def off_line(gamma: float) -> float:
        curve = Gamma(gamma=gamma)
        b = to_light(levels, curve if monitor == "unknown" else monitor).astype(np.float64)
        c = to_light(values, curve if camera == "unknown" else camera).astype(np.float64)
        design = np.stack([np.ones_like(b), b], axis=1)
        residual = c - design @ np.linalg.lstsq(design, c, rcond=None)[0]
        return float(np.sum(residual**2) / np.sum((c - c.mean(axis=0)) ** 2))

    found: Curve = "srgb"
    one = (monitor == "unknown") != (camera == "unknown")
    if one and len(np.unique(levels)) >= 3 and values.size > 0 and np.ptp(values, axis=0).any():
        best = minimize_scalar(off_line, bounds=(0.4, 4.0), method="bounded")
        found = Gamma(gamma=round(float(best.x), 4))
    return (found if monitor == "unknown" else monitor, found if camera == "unknown" else camera)
