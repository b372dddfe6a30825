"""A backdrop that is moved, scaled and turned in the plane of the monitor."""

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
        Displacement of its centre, in widths and heights of the monitor.
    scale : float
        Factor by which it is enlarged.
    angle : float
        Rotation about its centre, in degrees, clockwise.
    """

    right: float = 0.0
    down: float = 0.0
    scale: float = 1.0
    angle: float = 0.0

    def within(self, outer: "Placement") -> "Placement":
        """Where a backdrop stands that has this placement over ``outer``, which is not turned, and not the monitor."""
        return Placement(
            outer.right + outer.scale * self.right,
            outer.down + outer.scale * self.down,
            outer.scale * self.scale,
            self.angle,
        )

    def matrix(self, monitor: tuple[int, int]) -> NDArray[np.float64]:
        """The map from the monitor to the backdrop, both from 0 to 1 across and down.

        Parameters
        ----------
        monitor : (int, int)
            Width and height in square pixels: a rotation keeps shapes.

        Returns
        -------
        (3, 3) float64
            Of (x, y, 1).
        """
        wide, high = monitor
        turn = math.radians(self.angle)
        cosine, sine = math.cos(turn) / self.scale, math.sin(turn) / self.scale
        to_pixels = np.array([[wide, 0, -wide / 2], [0, high, -high / 2], [0, 0, 1]])
        back = np.array(
            [
                [cosine, sine, -(cosine * self.right * wide + sine * self.down * high)],
                [-sine, cosine, sine * self.right * wide - cosine * self.down * high],
                [0, 0, 1],
            ]
        )
        to_shares = np.array([[1 / wide, 0, 0.5], [0, 1 / high, 0.5], [0, 0, 1]])
        return np.asarray(to_shares @ back @ to_pixels)


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
    """Sample a picture bilinearly over some rows of a grid, at four points a cell; outside of it is black.

    Parameters
    ----------
    image : (h, w, 3) float32
        The part of the picture that the cells see, with pixels of about the size of a cell or larger.
    size : (int, int)
        Height and width of the picture.
    corner : (int, int)
        Row and column of the picture at which the image begins.
    matrix : (3, 3) float64
        From cells to pixels of the picture: a homography.
    start, stop : int
        Rows of the grid to compute.
    cells : (rows, columns, 3) float32
        Rows from ``start`` up to ``stop`` are written.
    """
    height, width = size
    top, left = corner
    for r in range(start, stop):
        for k in range(cells.shape[1]):
            sums = np.zeros(3, np.float32)
            for place in range(4):
                x, y = k + 0.25 + 0.5 * (place % 2), r + 0.25 + 0.5 * (place // 2)
                depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
                u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / depth
                v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / depth
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
