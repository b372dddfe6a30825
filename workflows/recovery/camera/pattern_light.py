"""The light of each pattern at some pixels, as a camera has measured it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class PatternLight(NamedTuple):
    """The light of m patterns at n pixels.

    Attributes
    ----------
    values : (n, m, 3) float32
        Linear camera values; 1 is full scale of the camera in the shortest exposure. Those that are not finite are
        ignored.
    usable : (n, m, 3) bool
        False where a value must be ignored, as where the camera clipped it.
    worth : (n, m, 3) float32
        The number of frames of the shortest exposure that carry as much information, above 0.
    """

    values: NDArray[np.float32]
    usable: NDArray[np.bool_]
    worth: NDArray[np.float32]

    @staticmethod
    def of(values: NDArray[np.float32], usable: NDArray[np.bool_] | None = None) -> "PatternLight":
        """Values of one frame each. Default: all are usable."""
        every = np.ones(values.shape, bool) if usable is None else usable
        return PatternLight(values, every, np.ones(values.shape, np.float32))

    def of_pixels(self, pixels: slice | NDArray[np.integer]) -> "PatternLight":
        """The light of some pixels."""
        return PatternLight(self.values[pixels], self.usable[pixels], self.worth[pixels])

    def of_patterns(self, patterns: NDArray[np.integer]) -> "PatternLight":
        """The light of some patterns."""
        return PatternLight(self.values[:, patterns], self.usable[:, patterns], self.worth[:, patterns])
