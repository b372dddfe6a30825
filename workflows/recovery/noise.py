"""The noise of frames, and its fit to samples of squared errors: the camera's, and that of lossy compression."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# No frame is exact: 16 bits alone leave this much.
LEAST_READ = 2e-11

_BINS = 12
# A chi-square variable's mean without its largest tenth: P(chi-square of 3 <= its 90th percentile) / 0.9.
_TRIM, _TRIMMED_CHI_SQUARE = 0.9, 0.623011


@dataclass(frozen=True)
class Noise:
    """Noise of one frame: a linear camera value v has the variance ``read + shot * max(v, 0)``.

    Attributes
    ----------
    read : float
        Variance at black, in units of full scale squared; quantisation is part of it.
    shot : float
        Growth of the variance with the value, in units of full scale.
    """

    read: float
    shot: float

    def variance(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Variance of linear camera values of any shape."""
        lit: NDArray[np.float32] = np.maximum(values, 0).astype(np.float32)
        return np.float32(self.read) + np.float32(self.shot) * lit


def noise_line(
    level: NDArray[np.floating], square: NDArray[np.floating], floor: float, *, trim: float = _TRIM
) -> Noise | None:
    """The noise of which there are samples.

    Parameters
    ----------
    level : (k,) float
        Linear camera values.
    square : (k,) float
        Squares of single errors at these, each its variance times a chi-square variable of one degree.
    floor : float
        The least variance.
    trim : float
        Share of the samples of a level that is used, the least ones: 0.9, or 1.

    Returns
    -------
    Noise or None
        None of fewer than 120 samples.
    """
    if level.size < 10 * _BINS:
        return None
    from scipy.optimize import nnls  # half a second to import, and who composites never comes here

    order = np.argsort(level, kind="stable")
    bins = np.array_split(order, _BINS)
    middle = np.array([level[b].mean() for b in bins])
    lowest = [np.sort(square[b])[: int(trim * len(b))] for b in bins]
    variance = np.array([least.mean() for least in lowest]) / (_TRIMMED_CHI_SQUARE if trim < 1 else 1)
    variance = np.maximum(variance, floor)
    # the error of a sample variance is in proportion to it
    design = np.stack([np.ones(_BINS), np.maximum(middle, 0)], axis=1) / variance[:, None]
    (read, shot), _ = nnls(design, np.ones(_BINS))
    return Noise(max(float(read), floor), float(shot))


def estimate_excess(
    values: NDArray[np.float32],
    black: NDArray[np.float32],
    white: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> Noise | None:
    """Estimate the noise of pattern frames from values that no pattern can cause.

    Lossy compression makes it differ from the noise of constant monitors.

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
