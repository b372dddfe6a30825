"""A backdrop that is moved, scaled and turned before the monitor's place."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray


@dataclass(frozen=True)
class Placement:
    """Where a backdrop stands; by default it is stretched over the monitor.

    Attributes
    ----------
    right, down : float
        By how much its centre is moved, in widths and heights of the monitor.
    scale : float
        By how much it is larger.
    angle : float
        By how much it is turned about its centre, in degrees, clockwise.
    """

    right: float = 0.0
    down: float = 0.0
    scale: float = 1.0
    angle: float = 0.0

    def matrix(
        self, cells: tuple[int, int], monitor: tuple[int, int], image: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Takes places on the grid of cells to places in the backdrop.

        Parameters
        ----------
        cells : (int, int)
            Columns and rows of the grid over the monitor.
        monitor : (int, int)
            Its width and height, in square pixels: what is turned keeps its shape on it.
        image : (int, int)
            Width and height of the backdrop.

        Returns
        -------
        (2, 3) float64
            Of (x, y, 1) in cells, from the top left of the grid, to (x, y) in pixels from the top left of the backdrop.
        """
        columns, rows = cells
        wide, high = monitor
        width, height = image
        turn = math.radians(self.angle)
        cosine, sine = math.cos(turn) / self.scale, math.sin(turn) / self.scale
        to_monitor = np.array([[wide / columns, 0, -wide / 2], [0, high / rows, -high / 2], [0, 0, 1]])
        back = np.array(
            [
                [cosine, sine, -(cosine * self.right * wide + sine * self.down * high)],
                [-sine, cosine, sine * self.right * wide - cosine * self.down * high],
                [0, 0, 1],
            ]
        )
        to_image = np.array([[width / wide, 0, width / 2], [0, height / high, height / 2]])
        return np.asarray(to_image @ back @ to_monitor)


@njit(nogil=True, cache=True)
def place(
    image: NDArray[np.float32],
    size: tuple[int, int],
    corner: tuple[int, int],
    matrix: NDArray[np.float64],
    start: int,
    stop: int,
    cells: NDArray[np.float32],
) -> None:
    """Sample a picture over some rows of a grid, four places a cell, between its pixels; beyond it is black.

    Parameters
    ----------
    image : (h, w, 3) float32
        What the cells see of the picture, of pixels no smaller than cells, about.
    size : (int, int)
        Height and width of the picture.
    corner : (int, int)
        Its row and column that the image begins with.
    matrix : (2, 3) float64
        From cells to pixels of the picture.
    start, stop : int
        Rows of the grid.
    cells : (rows, columns, 3) float32
        Written between `start` and `stop`.
    """
    height, width = size
    top, left = corner
    for r in range(start, stop):
        for k in range(cells.shape[1]):
            sums = np.zeros(3, np.float32)
            for place in range(4):
                x, y = k + 0.25 + 0.5 * (place % 2), r + 0.25 + 0.5 * (place // 2)
                u = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]
                v = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]
                if not (0 <= u < width and 0 <= v < height):
                    continue
                u, v = max(u - 0.5, 0.0), max(v - 0.5, 0.0)
                i, j = int(u), int(v)
                a, b = np.float32(u - i), np.float32(v - j)
                p, q = min(i + 1, width - 1) - left, min(j + 1, height - 1) - top
                i, j = i - left, j - top
                for c in range(3):
                    upper = image[j, i, c] + a * (image[j, p, c] - image[j, i, c])
                    lower = image[q, i, c] + a * (image[q, p, c] - image[q, i, c])
                    sums[c] += upper + b * (lower - upper)
            for c in range(3):
                cells[r, k, c] = sums[c] / np.float32(4)
