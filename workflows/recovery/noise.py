"""The noise of a camera's frames, and its fit to samples of squared errors."""

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
