"""The camera's movement, from positions that were measured frame by frame."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import median_filter

ROUNDS = 30
"""Rounds of weighing positions and steps by what they differ by."""
OUTLIER = 2.0
"""Standard errors beyond which a position gets ever less weight."""
NEAR = 5
"""Frames whose median position is where the path begins."""
STEP = 3.0
"""Steps from frame to frame are likely up to so many times the median."""
LEAST_STEP = 1e-3
"""Steps below this, in pixels, are none."""

Doubles = NDArray[np.float64]


def smooth_path(places: Doubles, errors: Doubles) -> Doubles:
    """The likely path of a camera that stands still, creeps or is jolted.

    Parameters
    ----------
    places : (n, k) float64
        Positions along k axes in each of n frames, in the order of time, in pixels.
    errors : (n, k) float64
        Their standard errors.

    Returns
    -------
    (n, k) float64

    Notes
    -----
    Coarse patterns hardly tell a movement, and what they tell is wrong where anything else is: a single frame then
    seems to be pixels away. Along each axis, ``sum h((z - x) / e) + sum |x_i+1 - x_i| / s`` is minimised by weighted
    least squares, h being the logarithm of Cauchy's distribution, and s a multiple of the median step of z. So a jolt
    stays as steep as it is, a frame that is out of line by itself does not count, and a camera that is never still is
    followed. The first and the last step count twice, as they would if time went on as in a mirror.
    """
    return np.stack(
        [_smooth(z, e) for z, e in zip(places.T, np.maximum(errors.T, LEAST_STEP), strict=True)], axis=1
    )


def _smooth(z: Doubles, e: Doubles) -> Doubles:
    if len(z) < 3:
        return z
    scale = STEP * max(float(np.median(np.abs(np.diff(z)))), LEAST_STEP)
    x = median_filter(z, NEAR, mode="mirror")
    for _ in range(ROUNDS):
        trust = 1 / (e**2 + ((z - x) / OUTLIER) ** 2)
        stiff = 1 / (scale * np.maximum(np.abs(np.diff(x)), LEAST_STEP))
        stiff[[0, -1]] *= 2
        diagonal = trust.copy()
        diagonal[:-1] += stiff
        diagonal[1:] += stiff
        x = solveh_banded(np.stack([np.append(0, -stiff), diagonal]), trust * z)
    return x
