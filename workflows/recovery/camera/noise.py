"""The noise of frames, fitted to samples of squared errors: of the camera, and of lossy compression."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_READ = 2e-11
"""Variance of quantisation to 16 bits, in units of full scale squared: the least noise of a frame."""
MEDIAN_TO_SIGMA = 1.4826
"""Standard deviation of normal values in medians of their magnitudes: one over the normal quantile of 0.75. Outliers
hardly change it (Hampel, "The influence curve and its role in robust estimation", J. Am. Stat. Assoc., 1974)."""

_BINS = 12
LEAST_SAMPLES = 10 * _BINS
"""Least samples that noise is fitted to."""
# The mean of a chi-square variable of 1 degree of freedom up to its 90th percentile q:
# P(chi-square of 3 degrees <= q) / 0.9.
_TRIM, _TRIMMED_CHI_SQUARE = 0.9, 0.623011


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one frame: a linear camera value v has the variance ``read + shot * max(v, 0)``.

    Attributes
    ----------
    read : float
        Variance at black, in units of full scale squared, quantisation included.
    shot : float
        Increase of the variance with the value, in units of full scale.
    """

    read: float
    shot: float

    def variance(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Variance of linear camera values of any shape."""
        positive: NDArray[np.float32] = np.maximum(values, 0).astype(np.float32)
        return np.float32(self.read) + np.float32(self.shot) * positive


def fit_noise(
    level: NDArray[np.floating], square: NDArray[np.floating], floor: float, *, trim: float = _TRIM
) -> NoiseModel | None:
    """Fit noise to samples of squared errors.

    Parameters
    ----------
    level : (k,) float
        Linear camera values.
    square : (k,) float
        Squared errors at these values, each the variance times a chi-square variable of one degree of freedom.
    floor : float
        Least read noise, as a variance.
    trim : float
        Share of the samples of a bin that is used, the smallest ones: 0.9 or 1.

    Returns
    -------
    NoiseModel or None
        None if there are fewer than 120 samples.

    Examples
    --------
    >>> level, error = np.linspace(0, 1, 12_000), np.random.default_rng(0).standard_normal(12_000)
    >>> noise = fit_noise(level, (1e-6 + 1e-5 * level) * error**2, LEAST_READ)
    >>> print(f"{noise.shot:.0e}")
    1e-05
    """
    if level.size < LEAST_SAMPLES:
        return None
    from scipy.optimize import nnls  # takes half a second to import, and compositing does not need it

    order = np.argsort(level, kind="stable")
    cuts = level.size * np.arange(1, _BINS) // _BINS
    # No bin has both dark and bright values: those that are trimmed would all be bright.
    half = np.searchsorted(level[order], (level.min() + level.max()) / 2)
    bins = [b for b in np.split(order, np.union1d(cuts, half)) if b.size >= LEAST_SAMPLES // _BINS]
    middle = np.array([level[b].mean() for b in bins])
    lowest = [np.sort(square[b])[: int(trim * len(b))] for b in bins]
    variance = np.array([least.mean() for least in lowest]) / (_TRIMMED_CHI_SQUARE if trim < 1 else 1)
    variance = np.maximum(variance, floor)
    # the standard error of the variance of n samples is proportional to it, and to 1 / sqrt(n)
    weight = np.sqrt([b.size for b in bins])
    design = np.stack([np.ones(len(bins)), np.maximum(middle, 0)], axis=1) * (weight / variance)[:, None]
    (read, shot), _ = nnls(design, weight)
    return NoiseModel(max(float(read), floor), float(shot))


def estimate_excess(
    values: NDArray[np.float32],
    black: NDArray[np.float32],
    white: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> NoiseModel | None:
    """Estimate the noise of pattern frames from values below black or above white, which only noise can cause.

    Lossy compression makes it differ from the noise of constant monitors.

    Parameters
    ----------
    values : (n, m, 3) float32
        Linear camera values of n pixels under m patterns.
    black, white : (n, 3) float32
        Their values under a black and a white monitor.
    usable : (n, m, 3) bool
        False where a value must be ignored, as where the camera clipped it.

    Returns
    -------
    NoiseModel or None
        None if too few values are outside the range from black to white.

    Notes
    -----
    Without noise, a pixel under any pattern is between black and white (eq. 5: T is not negative). If it sees the
    pattern as all black or all white, half of its values are outside, and the squared distance is the noise's variance
    times a chi-square variable of one degree of freedom. If it sees it as nearly so, fewer values are outside and
    closer. If all values up to the limit were equally frequent, the mean square would be two thirds of the variance
    (``int t^2 Q(t) dt / int Q(t) dt``, Q the normal tail). This is assumed, since too high an estimate of the noise
    does less harm than too low a one. Large errors are not trimmed, because compression causes many.
    """
    levels, squares = [np.zeros(0)], [np.zeros(0)]
    for edge, sign in ((black, -1), (white, 1)):
        beyond = sign * (values - edge[:, np.newaxis])
        outside = usable & (beyond > 0)
        levels.append(np.broadcast_to(edge[:, np.newaxis], values.shape)[outside].astype(np.float64))
        squares.append(beyond[outside].astype(np.float64) ** 2)
    return fit_noise(np.concatenate(levels), 1.5 * np.concatenate(squares), LEAST_READ, trim=1)
