"""What values that the camera has clipped still say: the light was at least, or at most, so bright."""

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.photometry import Photometry

NARROWEST = 0.1
"""Light that a pixel clipped at white may have seen beyond its clipped value, at least, as a share of rho."""
DEVIATION = 2.0
"""Standard deviation of a clipped value, in widths of the range that it stands for, which is not known exactly."""
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


def bound_clipped(
    measurements: Floats,
    usable: Bools,
    worth: Floats,
    filmed: Bools,
    photometry: Photometry,
    noise: NoiseModel,
) -> tuple[Floats, Bools, Floats]:
    """Replace clipped values by what the light can have been, to be used with less weight.

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values of n pixels under m patterns.
    usable : (n, m, 3) bool
        False where a value, or with crosstalk that of another channel, is clipped.
    worth : (n, m, 3) float32
        How many frames each value is worth, above 0.
    filmed : (m,) bool
        False where there is no frame of a pattern.
    photometry : Photometry
        S and rho of the n pixels.
    noise : NoiseModel

    Returns
    -------
    measurements : (n, m, 3) float32
    usable : (n, m, 3) bool
        False only where there is no frame.
    worth : (n, m, 3) float32

    Notes
    -----
    No pattern is brighter than white or darker than black: a pixel that is clipped at white saw between the clipped
    value and S + rho, one that is clipped at black between S and the value. It counts as the middle of that. Where
    bright patterns clip, this is most of what a film says of T, for else little is left but what is black.
    """
    if usable.all():
        return np.ascontiguousarray(measurements), usable, worth
    S, rho = photometry.S[:, np.newaxis], photometry.rho[:, np.newaxis]
    bright = measurements > S + rho / 2
    over, under = np.maximum(S + rho - measurements, NARROWEST * rho), np.maximum(measurements - S, 0)
    width = np.where(bright, over, under)
    middle = measurements + np.where(bright, width, -width) / 2
    before = noise.variance(middle)
    bounded = worth * before / (before + worth * (DEVIATION * width) ** 2)
    return (
        np.ascontiguousarray(np.where(usable, measurements, middle), np.float32),
        usable | filmed[:, np.newaxis],
        np.where(usable, worth, bounded).astype(np.float32),
    )
