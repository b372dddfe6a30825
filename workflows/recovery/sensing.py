"""What the patterns of a program say about each cell of the monitor, on each of the program's grids."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.pyramid import Pyramid


@dataclass(frozen=True)
class Level:
    """A grid laid over the monitor, and the light of every pattern on its cells.

    A pattern of a coarser grid that nests in this one is constant on each cell here, so its row is exact
    and is listed too.

    Attributes
    ----------
    columns, rows : int
        The grid; cell ``row * columns + column``, row 0 at the top.
    patterns : (m,) intp
        The measurements that this level may use: indices along axis 1 of the measurements, ascending.
    light : (channels, rows * columns, m) float32
        Light that each pattern sends from each cell, 0 (black) to 1 (white). One channel if every pattern is
        grey, else three.
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
    """The light of every pattern on the nodes of a pyramid over the monitor.

    Attributes
    ----------
    pyramid : Pyramid
    channels : int
        1 if every pattern is grey, else 3.
    code : (pyramid.nodes, channels * m) uint8
        Light, 0 (black) to 255 (white), of the m patterns channel after channel. A byte is enough: a lobe sees many
        nodes, and a camera's noise is larger.
    """

    pyramid: Pyramid
    channels: int
    code: NDArray[np.uint8]

    @property
    def count(self) -> int:
        """m."""
        return int(self.code.shape[1]) // self.channels
