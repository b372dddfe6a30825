"""How far a composite may be from the truth: intervals that hold it with a probability of 90 %.

What a recovery leaves undetermined is where exactly, within a cell or so, the light comes from. Before a backdrop that
is flat there this makes no error, so it is the backdrop's contrast within the reach of some cells that counts. How much
it counts is measured for each capture: some of its patterns are held out, and predicted from the others.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.pyramid import Pyramid

COVERED = 0.9
"""The probability of an interval."""
QUANTILE = np.float32(1.6449)
"""Half its width in standard deviations of a normal distribution."""
REACH = 2
"""Grids from that of a node to the one whose nodes are its surroundings: four times as wide."""
HELD_OUT = 8
"""One of so many patterns is held out."""
FIT_VARIANCE = 2.5
"""Variance that S, rho and the sum of T add to a composite, in variances of the mean of all frames."""
CALM = 0.2
"""Share of the errors where there is least contrast."""
POWER = 0.75
"""Power of the contrast that the variance of errors grows with, before patterns and before other backdrops."""
GROWTH = 3
"""Power of the share of the patterns that were used, by which the variance of errors is smaller than when some are held
out. In the median the recovery itself gains by 1.5; the rest is fitted to backdrops before traced glass, which are not
as hard to predict as patterns."""
_SMALLEST, _LARGEST, _HALVINGS = -12.0, 3.0, 40  # powers of ten

Floats = NDArray[np.float32]


class Interval(NamedTuple):
    """The variance of a composite's error, ``contrast (rho^2 T W)^(3/4) + read + shot C + share rho^2``.

    W is the contrast of the backdrop, see `local_contrast`, and C the composite.

    Attributes
    ----------
    contrast : float
        Of what the recovery leaves undetermined.
    read, shot : float
        Of the noise in S and rho, in units of full scale squared, and of full scale. The first is also of whatever else
        is the same for all pixels and backdrops.
    share : float
        Of light from far away, and of errors of the model.
    """

    contrast: float
    read: float
    shot: float
    share: float

    def wider(self, factor: float) -> "Interval":
        """The interval that is a number of times as wide."""
        return Interval(*(factor**2 * part for part in self))

    def half_width(self, composite: Floats, rho: Floats, arrived: Floats) -> Floats:
        """Half the width of the interval, in camera units.

        Parameters
        ----------
        composite, rho, arrived : (...) float32
            C, rho, and rho T W.
        """
        variance = self.contrast * np.maximum(rho * arrived, 0) ** POWER + self.share * rho**2
        variance += self.read + self.shot * np.maximum(composite, 0)
        half: Floats = QUANTILE * np.sqrt(np.maximum(variance, 0)).astype(np.float32)
        return half


def local_contrast(pyramid: Pyramid, mean: Floats, square: Floats) -> Floats:
    """The variance of light in the surroundings of each node.

    Parameters
    ----------
    pyramid : Pyramid
    mean, square : (nodes, k) float32
        The light of k pictures, and its square, at the nodes.

    Returns
    -------
    (nodes, k) float32
        Of a cell, the variance within the node two grids further that is about it.
    """
    reach = min(REACH, len(pyramid.grids) - 1)
    around = Pyramid(pyramid.grids[reach:])
    columns, rows = around.grids[0]
    at = slice(pyramid.starts[reach], pyramid.starts[reach + 1])
    variance = np.maximum(square[at] - mean[at] ** 2, 0).reshape(rows, columns, -1)
    finer = [
        variance.repeat(1 << by, axis=1)[:, :wide].repeat(1 << by, axis=0)[:high].reshape(wide * high, -1)
        for by, (wide, high) in zip(range(reach, 0, -1), pyramid.grids, strict=False)
    ]
    return np.concatenate([*finer, around.light(variance)])


def fit_interval(
    error: NDArray[np.floating],
    contrast: NDArray[np.floating],
    variance: NDArray[np.floating],
    rho: float,
    noise: NoiseModel,
    frames: float,
    errors: tuple[float, float],
    held_out: float,
) -> Interval:
    """Fit an interval to predictions of patterns that a recovery has not seen.

    Parameters
    ----------
    error, contrast, variance : (k,) float
        What was measured less what was predicted; rho squared times T W of the pattern; the variance of the
        measurement, errors of the model included.
    rho : float
        Of a usual pixel.
    noise : NoiseModel
        Of a frame.
    frames : float
        In which a pixel was seen, all patterns together.
    errors : (float, float)
        Standard deviations of errors of the model in a measurement and in a composite, as shares of rho.
    held_out : float
        Share of the patterns that the recovery has not seen, and another will.

    Returns
    -------
    Interval

    Notes
    -----
    Light from far away is wrong where the backdrop has no contrast, too: the ``share`` is that by which, among the
    `CALM` fifth of the errors with least contrast, 90 % lie in their interval, the noise of the measurement included.
    The ``contrast`` is then that by which 90 % of all do. If it had to make errors larger than the contrast, in the
    mean, as if light came from beyond all that is around, it is not contrast that makes them, and the share alone is
    fitted to all. Both are those of the capture: which of its pixels are better recovered than others, the contrast
    that they see tells only in part. Before backdrops, a recovery from all patterns has smaller errors, see `GROWTH`.
    """
    each = FIT_VARIANCE / max(frames, 1.0)
    known = variance * (1 + each)
    calm = contrast <= np.quantile(contrast, CALM)
    further = _least_of(error[calm], np.ones(np.count_nonzero(calm)), known[calm])
    grown = contrast**POWER
    found = _least_of(error, grown, known + further)
    if found * grown.mean() > contrast.mean():
        found, further = 0.0, _least_of(error, np.ones(error.size), known)
    smaller = (1 - held_out) ** GROWTH
    in_measurement, in_composite = errors
    share = each * in_measurement**2 + in_composite**2 + smaller * further / rho**2
    return Interval(smaller * found, each * noise.read, each * noise.shot, share)


def _least_of(
    error: NDArray[np.floating], factor: NDArray[np.floating], known: NDArray[np.floating]
) -> float:
    """The least number of times a factor is in the variance of errors, beside what is known, by 90 % of them."""
    low, high = _SMALLEST, _LARGEST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        inside = error**2 <= QUANTILE**2 * (10**middle * factor + known)
        low, high = (low, middle) if inside.mean() >= COVERED else (middle, high)
    return 10**high
