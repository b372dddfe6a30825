"""Whether a quantity that is looked at again and again grows: a line through its values, against their scatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SURE = 4.0
"""Standard errors of the growth by which it has to differ from none."""


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
        Growth that is none: a page more, a thread of a pool.
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
        """Whether it is more than is allowed, and than scatter makes."""
        return self.growth > self.allowed and self.growth > SURE * self.error


def trend(values: Sequence[float], *, least: float, share: float) -> Trend:
    """Fit a line by least squares.

    Parameters
    ----------
    values : sequence of float
        Three or more.
    least, share : float
        Growth that is allowed: so much, or that share of the mean if that is more.
    """
    y = np.asarray(values, float)
    x = np.arange(len(y)) - (len(y) - 1) / 2
    slope = (x @ y) / (x @ x)
    scatter = y - y.mean() - slope * x
    error = np.sqrt(scatter @ scatter / (len(y) - 2) / (x @ x))
    span = len(y) - 1
    ends = y.mean() + slope * x[[0, -1]]
    return Trend(float(ends[0]), float(ends[1]), float(error * span), max(least, share * float(y.mean())))
