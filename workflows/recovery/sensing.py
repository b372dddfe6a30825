"""What the patterns of a program say about each cell of the monitor, on each of the program's grids."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
