"""The noise of frames before patterns, where it differs from that before constant monitors: lossy compression."""

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.noise import LEAST_READ, Noise, noise_line


def estimate_excess(
    values: NDArray[np.float32],
    black: NDArray[np.float32],
    white: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> Noise | None:
    """Estimate the noise of frames of patterns from the values that no pattern can cause.

    Parameters
    ----------
    values : (n, m, 3) float32
        Linear camera values of n pixels before m patterns.
    black, white : (n, 3) float32
        Their values before a black and a white monitor.
    usable : (n, m, 3) bool
        False where a value says nothing, as where the camera clipped it.

    Returns
    -------
    Noise or None
        None if too few values lie beyond black and white.

    Notes
    -----
    Before any pattern a pixel is between black and white (eq. 5: T is not negative). What lies beyond is noise. Where
    the pattern is all black or all white for the pixel, half of the values do, and the square of the distance is the
    noise's variance times a chi-square variable of one degree. Where it is nearly so, fewer lie beyond and less far:
    were all values up to the edge equally frequent, the mean square would be two thirds of the variance
    (``int t^2 Q(t) dt / int Q(t) dt``, Q the normal tail), and this is what is assumed: too much noise costs
    little, too little much. Large errors count in full, for compression has many.
    """
    levels, squares = [np.zeros(0)], [np.zeros(0)]
    for edge, sign in ((black, -1), (white, 1)):
        beyond = sign * (values - edge[:, np.newaxis])
        there = usable & (beyond > 0)
        levels.append(np.broadcast_to(edge[:, np.newaxis], values.shape)[there].astype(np.float64))
        squares.append(beyond[there].astype(np.float64) ** 2)
    return noise_line(np.concatenate(levels), 1.5 * np.concatenate(squares), LEAST_READ, trim=1)
