"""The light of a program's patterns on the cells of the monitor, on each of the program's grids."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.pyramid import Pyramid


@dataclass(frozen=True)
class Level:
    """A grid over the monitor, and the light of patterns on its cells.

    Patterns of a coarser grid that nests in this one are constant on each cell, so they are included.

    Attributes
    ----------
    columns, rows : int
        The grid; cell ``row * columns + column``, row 0 at the top.
    patterns : (m,) intp
        Indices of the patterns, ascending, along axis 1 of the measurements.
    light : (channels, rows * columns, m) float32
        Light of each pattern on each cell, 0 (black) to 1 (white). One channel if all patterns are grey, else three.
    """

    columns: int
    rows: int
    patterns: NDArray[np.intp]
    light: NDArray[np.float32]


@dataclass(frozen=True)
class Sensing:
    """The levels of a program from coarse to fine; each grid is a whole multiple of the one before it."""

    levels: tuple[Level, ...]


@dataclass(frozen=True)
class Patterns:
    """The light of all patterns on the nodes of a pyramid over the monitor.

    Attributes
    ----------
    pyramid : Pyramid
    channels : int
        1 if all patterns are grey, else 3.
    code : (pyramid.nodes, channels * m) uint8
        Light, 0 (black) to 255 (white), of the m patterns, channel after channel. 8 bits are enough: a lobe averages
        many nodes, and a camera's noise is larger than the rounding error.
    """

    pyramid: Pyramid
    channels: int
    code: NDArray[np.uint8]

    @property
    def count(self) -> int:
        """The number of patterns, m."""
        return int(self.code.shape[1]) // self.channels
