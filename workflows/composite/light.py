"""The light of a backdrop at the nodes of T: resampled to the monitor's cells, then from grid to coarser grid."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.composite.placing import Placement, place
from workflows.composite.threads import in_parts
from workflows.recovery.pyramid import Pyramid

ROWS = 64
"""Rows of cells that are made at a time: what is held of a large backdrop as float is what they see."""


@dataclass(frozen=True)
class Backdrop:
    """A picture to put a matte before.

    Attributes
    ----------
    pixels : (h, w, 1 or 3) uint8, uint16 or float32
    table : (256 or 65536,) float32, optional
        Linear light of every value of an integer type; float values are linear light.
    """

    pixels: NDArray[np.integer] | NDArray[np.float32]
    table: NDArray[np.float32] | None = None

    def light(self, rows: slice) -> NDArray[np.float32]:
        """Linear light of some rows, (h, w, 1 or 3) float32."""
        values = self.pixels[rows]
        if self.table is None:
            return np.asarray(values, np.float32)
        return self.table.take(cast("NDArray[np.integer]", values))


def node_light(
    backdrop: Backdrop,
    columns: int,
    rows: int,
    threads: int,
    placement: Placement | None = None,
    monitor: tuple[int, int] = (1, 1),
) -> NDArray[np.float32]:
    """The light that the nodes of a pyramid see of a backdrop.

    Parameters
    ----------
    backdrop : Backdrop
    columns, rows : int
        The pyramid's first grid.
    threads : int
        To share the work.
    placement : Placement, optional
        Where it stands; default stretched over the monitor.
    monitor : (int, int)
        The monitor's width and height, for a placement.

    Returns
    -------
    (nodes + 1, 3) float32
        Row by row; the last one is 0, and nobody's: `gather` reads past a node's three values.

    Notes
    -----
    A cell sees the mean of the backdrop over it, as the patterns' blocks were to it: nothing aliases, whatever the
    backdrop's size. A backdrop that is placed elsewhere is first made as coarse as the cells, by means too, and then
    sampled between its pixels. Further grids see what `Pyramid` says.
    """
    pyramid = Pyramid.over(columns, rows)
    light = np.empty((pyramid.nodes + 1, 3), np.float32)
    light[-1] = 0
    starts, grids = pyramid.starts, pyramid.grids
    finest = light[: starts[1]].reshape(rows, columns, 3)
    if placement is None:
        _resample(backdrop, finest, threads)
    else:
        _place(backdrop, placement, monitor, finest, threads)
    for level in range(1, len(grids)):
        fine = light[starts[level - 1] : starts[level]].reshape(*grids[level - 1][::-1], 3)
        coarse = light[starts[level] : starts[level + 1]].reshape(*grids[level][::-1], 3)

        def halve(start: int, fine: NDArray[np.float32] = fine, coarse: NDArray[np.float32] = coarse) -> None:
            _halve(fine, start, min(start + ROWS, len(coarse)), coarse)

        in_parts(halve, range(0, len(coarse), ROWS), threads)
    return light


def _resample(backdrop: Backdrop, cells: NDArray[np.float32], threads: int) -> None:
    """Stretch a backdrop over cells (rows, columns, 3): each gets the mean over it."""
    rows, (height, width, _) = len(cells), backdrop.pixels.shape

    def some(start: int) -> None:
        stop = min(start + ROWS, rows)
        first = start * height // rows
        seen = backdrop.light(slice(first, -(-stop * height // rows)))
        _area_mean(seen, first, height, width, start, stop, cells)

    in_parts(some, range(0, rows, ROWS), threads)


def _place(
    backdrop: Backdrop,
    placement: Placement,
    monitor: tuple[int, int],
    cells: NDArray[np.float32],
    threads: int,
) -> None:
    """Place a backdrop before cells (rows, columns, 3)."""
    rows, columns, _ = cells.shape
    height, width, _ = backdrop.pixels.shape
    steps = np.hypot(*placement.matrix((columns, rows), monitor, (width, height))[:, :2].T)
    wide, high = (math.ceil(size / max(step, 1.0)) for size, step in zip((width, height), steps, strict=True))
    if (wide, high) == (width, height):
        picture = backdrop.light(slice(None))
    else:
        picture = np.empty((high, wide, 3), np.float32)
        _resample(backdrop, picture, threads)
    matrix = placement.matrix((columns, rows), monitor, (wide, high))
    in_parts(
        lambda start: place(picture, matrix, start, min(start + ROWS, rows), cells),
        range(0, rows, ROWS),
        threads,
    )


@njit(nogil=True, cache=True)
def _area_mean(
    image: NDArray[np.float32],
    first: int,
    height: int,
    width: int,
    start: int,
    stop: int,
    cells: NDArray[np.float32],
) -> None:
    """The mean over each cell of some rows of a grid, of an image that is constant over each of its pixels.

    Parameters
    ----------
    image : (h, width, 1 or 3) float32
        Those of its rows that are seen, from `first` on.
    height, width : int
        Of the image.
    start, stop : int
        Rows of the grid.
    cells : (rows, columns, 3) float32
        Written between `start` and `stop`.
    """
    rows, columns, _ = cells.shape
    channels = image.shape[2]
    line = np.empty((width, channels), np.float32)
    for r in range(start, stop):
        line[:] = 0
        top, bottom = r * height / rows, (r + 1) * height / rows
        for y in range(int(top), min(int(np.ceil(bottom)), height)):
            share = np.float32((min(bottom, y + 1.0) - max(top, float(y))) / (bottom - top))
            for x in range(width):
                for c in range(channels):
                    line[x, c] += share * image[y - first, x, c]
        for k in range(columns):
            left, right = k * width / columns, (k + 1) * width / columns
            red = green = blue = np.float32(0)
            for x in range(int(left), min(int(np.ceil(right)), width)):
                share = np.float32((min(right, x + 1.0) - max(left, float(x))) / (right - left))
                red += share * line[x, 0]
                green += share * line[x, channels // 2]
                blue += share * line[x, channels - 1]
            cells[r, k, 0], cells[r, k, 1], cells[r, k, 2] = red, green, blue


@njit(nogil=True, cache=True)
def _halve(fine: NDArray[np.float32], start: int, stop: int, coarse: NDArray[np.float32]) -> None:
    """Some rows of the next grid: every second node seen with the weights [1, 3, 3, 1] / 8 along each axis."""
    rows, columns, _ = fine.shape
    line = np.empty((columns, 3), np.float32)
    three, eighth = np.float32(3), np.float32(1 / 8)
    for r in range(start, stop):
        above, upper = fine[max(2 * r - 1, 0)], fine[2 * r]
        lower, below = fine[min(2 * r + 1, rows - 1)], fine[min(2 * r + 2, rows - 1)]
        for x in range(columns):
            for c in range(3):
                line[x, c] = eighth * (above[x, c] + below[x, c] + three * (upper[x, c] + lower[x, c]))
        for k in range(coarse.shape[1]):
            a, b = max(2 * k - 1, 0), 2 * k
            d, e = min(2 * k + 1, columns - 1), min(2 * k + 2, columns - 1)
            for c in range(3):
                coarse[r, k, c] = eighth * (line[a, c] + line[e, c] + three * (line[b, c] + line[d, c]))
