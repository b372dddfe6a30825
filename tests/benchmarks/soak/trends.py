"""Whether a repeatedly measured quantity grows: a line through its values, compared with their scatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SURE = 4.0
"""Standard errors by which growth must exceed zero."""


@dataclass(frozen=True)
class Trend:
    """The line through equally spaced values of a quantity.

    Attributes
    ----------
    first, last : float
        The line's ends.
    error : float
        Standard error of the growth from one to the other.
    allowed : float
        Growth that is tolerated: another page, a thread of a pool.
    """

    first: float
    last: float
    error: float
    allowed: float

    @property
    def growth(self) -> float:
        """From the first value to the last."""
        return self.last - self.first

    @property
    def grows(self) -> bool:
        """Whether it exceeds what is tolerated and what scatter explains."""
        return self.growth > self.allowed and self.growth > SURE * self.error


def trend(values: Sequence[float], *, least: float, share: float) -> Trend:
    """Fit a line by least squares.

    Parameters
    ----------
    values : sequence of float
        Three or more.
    least, share : float
        Tolerated growth: an absolute value, or a share of the mean if that is more.
    """
    y = np.asarray(values, float)
    x = np.arange(len(y)) - (len(y) - 1) / 2
    slope = (x @ y) / (x @ x)
    scatter = y - y.mean() - slope * x
    error = np.sqrt(scatter @ scatter / (len(y) - 2) / (x @ x))
    span = len(y) - 1
    ends = y.mean() + slope * x[[0, -1]]
    return Trend(float(ends[0]), float(ends[1]), float(error * span), max(least, share * float(y.mean())))
