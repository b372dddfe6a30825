"""What values that the camera has clipped still say: the light was at least, or at most, so bright."""

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry

NARROWEST = 0.1
"""Light that a pixel clipped at white may have seen beyond its clipped value, at least, as a share of rho."""
DEVIATION = 2.0
"""Standard deviation of a clipped value, in widths of the range that it stands for, which is not known exactly."""


def bound_clipped(
    light: PatternLight, filmed: NDArray[np.bool_], photometry: Photometry, noise: NoiseModel
) -> PatternLight:
    """Replace clipped values by what the light can have been, to be used with less weight.

    Parameters
    ----------
    light : PatternLight
        Of n pixels under m patterns; not usable where a value, or with crosstalk that of another channel, is clipped.
    filmed : (m,) bool
        False where there is no frame of a pattern.
    photometry : Photometry
        S and rho of the n pixels.
    noise : NoiseModel

    Returns
    -------
    PatternLight
        Not usable only where there is no frame.

    Notes
    -----
    No pattern is brighter than white or darker than black: a pixel that is clipped at white saw between the clipped
    value and S + rho, one that is clipped at black between S and the value. It counts as the middle of that. Where
    bright patterns clip, this is most of what a film says of T, for else little is left but what is black.
    """
    values, usable, worth = light
    if usable.all():
        return light._replace(values=np.ascontiguousarray(values))
    S, rho = photometry.S[:, np.newaxis], photometry.rho[:, np.newaxis]
    bright = values > S + rho / 2
    over, under = np.maximum(S + rho - values, NARROWEST * rho), np.maximum(values - S, 0)
    width = np.where(bright, over, under)
    middle = values + np.where(bright, width, -width) / 2
    before = noise.variance(middle)
    bounded = worth * before / (before + worth * (DEVIATION * width) ** 2)
    return PatternLight(
        np.ascontiguousarray(np.where(usable, values, middle), np.float32),
        usable | filmed[:, np.newaxis],
        np.where(usable, worth, bounded).astype(np.float32),
    )
