"""Tone curves: between the value sent to a monitor, or stored by a camera, and linear light."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

SAMPLES = 256
"""Samples of a measured curve: one for each code of 8 bits."""
BLACK = 4096
"""The code of no light where float values are stored as uint16, so that negative noise has codes below it."""


class Gamma(BaseModel):
    """A pure power law: light = value ** gamma."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    gamma: Annotated[float, Field(ge=0.2, le=5.0, description="The exponent.", examples=[2.2])]


class Sampled(BaseModel):
    """A measured curve: the light at equally spaced values from 0 to 1, with straight lines between them."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    light: Annotated[tuple[float, ...], Field(min_length=SAMPLES, max_length=SAMPLES)]


Curve = Literal["linear", "srgb"] | Gamma | Sampled
CameraCurve = Curve | tuple[Curve, Curve, Curve]
"""The curve of a camera: one for all channels, or one for each."""
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
    if isinstance(curve, Sampled):
        return np.interp(values, np.linspace(0, 1, SAMPLES), curve.light).astype(np.float32)
    return np.maximum(values, 0) ** np.float32(curve.gamma)


def from_light(light: NDArray[np.float32], curve: Literal["linear", "srgb"]) -> NDArray[np.float32]:
    """Encoded values of linear light, the inverse of `to_light`."""
    if curve == "linear":
        return light
    low = light * np.float32(12.92)
    high = np.float32(1.055) * np.maximum(light, 0) ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.where(light <= 0.0031308, low, high)


def table(curve: CameraCurve, dtype: np.dtype[np.unsignedinteger], black: int = 0) -> NDArray[np.float32]:
    """A look-up table from every value of an unsigned integer type to linear light, for `light_of_codes`.

    It is (k,), or (k, 3) where each channel has its own curve. ``black`` is the value of no light; values below it are
    negative light.
    """
    if isinstance(curve, tuple):
        return np.stack([table(own, dtype, black) for own in curve], axis=1)
    top = np.iinfo(dtype).max
    return to_light((np.arange(top + 1, dtype=np.float32) - black) / np.float32(top - black), curve)


def light_of_codes(codes: NDArray[np.unsignedinteger], look_up: NDArray[np.float32]) -> NDArray[np.float32]:
    """The light of codes, (..., channels), by a `table`."""
    light: NDArray[np.float32]
    light = look_up[codes] if look_up.ndim == 1 else look_up[codes, np.arange(look_up.shape[1])]
    return light
