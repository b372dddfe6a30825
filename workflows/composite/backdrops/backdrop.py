"""The light of a backdrop at the nodes of T: resampled to the monitor's cells, then to coarser and coarser grids."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.composite.backdrops.placement import Placement, place
from workflows.images.decode import Transfer
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import table
from workflows.recovery.pyramid import Pyramid
from workflows.threads import in_parts

ROWS = 64
"""Rows of cells that a thread computes at a time."""


@dataclass(frozen=True)
class Backdrop:
    """A picture behind a matte.

    Attributes
    ----------
    pixels : (h, w, 1 to 4) uint8 or uint16, or (h, w, 1 or 3) float32
        Two or four channels include alpha: transparent pixels are black, in proportion.
    table : (256 or 65536,) float32, optional
        Linear light of every integer value; float values are linear light.
    """

    pixels: NDArray[np.integer] | NDArray[np.float32]
    table: NDArray[np.float32] | None = None


def backdrop_of(pixels: Codes | Floats, transfer: Transfer) -> Backdrop:
    """Make a backdrop of a picture from `workflows.images.decode.decode`.

    Parameters
    ----------
    pixels : (h, w, 1 to 4) uint8 or uint16, or (h, w, 1 or 3) float32
        Two or four channels include alpha.
    transfer : str
        How integers encode light; float values are linear light.

    Returns
    -------
    Backdrop
        Transparent pixels are black, in proportion, because there is no light behind them.
    """
    if pixels.dtype == np.float32:
        return Backdrop(cast("Floats", pixels))
    codes = cast("Codes", pixels)
    return Backdrop(codes, table(transfer, codes.dtype))


def node_light(
    backdrop: Backdrop,
    columns: int,
    rows: int,
    threads: int,
    placement: Placement | None = None,
    monitor: tuple[int, int] = (1, 1),
) -> NDArray[np.float32]:
    """The light of a backdrop at the nodes of a pyramid.

    Parameters
    ----------
    backdrop : Backdrop
    columns, rows : int
        The pyramid's first grid.
    threads : int
        Threads to use.
    placement : Placement, optional
        Where the backdrop stands; by default it is stretched over the monitor.
    monitor : (int, int)
        Width and height of the monitor; needed with a placement.

    Returns
    -------
    (nodes + 1, 3) float32
        Row by row. The last one is padding and 0, because `gather` reads four values at each node.

    Notes
    -----
    A cell gets the mean of the backdrop over it, as it did of the patterns, so nothing aliases, whatever the size of
    the backdrop. A backdrop with a placement is first averaged to about the size of the cells, and then sampled with
    bilinear interpolation. Coarser grids are computed as in `Pyramid`.
    """
    pyramid = Pyramid.over(columns, rows)
    light = np.empty((pyramid.nodes + 1, 3), np.float32)
    light[-1] = 0
    starts, grids = pyramid.starts, pyramid.grids
    finest = light[: starts[1]].reshape(rows, columns, 3)
    if placement is None:
        _resample(backdrop, finest, threads, (rows, columns))
    else:
        _place(backdrop, placement.matrix(monitor), finest, threads)
    for level in range(1, len(grids)):
        fine = light[starts[level - 1] : starts[level]].reshape(*grids[level - 1][::-1], 3)
        coarse = light[starts[level] : starts[level + 1]].reshape(*grids[level][::-1], 3)

        def halve(start: int, fine: NDArray[np.float32] = fine, coarse: NDArray[np.float32] = coarse) -> None:
            _halve(fine, start, min(start + ROWS, len(coarse)), coarse)

        in_parts(halve, range(0, len(coarse), ROWS), threads)
    return light


def frame_light(
    backdrop: Backdrop,
    width: int,
    height: int,
    threads: int,
    seen: NDArray[np.float64] | None = None,
) -> NDArray[np.float32]:
    """The light of a backdrop at the pixels of a frame.

    Parameters
    ----------
    backdrop : Backdrop
    width, height : int
        Of the frame.
    threads : int
    seen : (3, 3) float64, optional
        The homography from the frame to the backdrop, both from 0 to 1 across and down. By default the frame sees all
        of the backdrop.

    Returns
    -------
    (height, width, 3) float32
    """
    light = np.empty((height, width, 3), np.float32)
    if seen is None:
        _resample(backdrop, light, threads, (height, width))
    else:
        _place(backdrop, seen, light, threads)
    return light


def _resample(
    backdrop: Backdrop,
    cells: NDArray[np.float32],
    threads: int,
    grid: tuple[int, int],
    corner: tuple[int, int] = (0, 0),
) -> None:
    """Average a backdrop, stretched over a grid of rows and columns, over each cell.

    Only ``cells`` (rows, columns, 3) are computed, which begin at row and column ``corner`` of the grid.
    """
    in_parts(
        lambda start: _area_mean(
            backdrop.pixels, backdrop.table, grid, corner, start, min(start + ROWS, len(cells)), cells
        ),
        range(0, len(cells), ROWS),
        threads,
    )


def _place(backdrop: Backdrop, seen: NDArray[np.float64], cells: NDArray[np.float32], threads: int) -> None:
    """Compute cells (rows, columns, 3) by a homography from their grid to the backdrop, both from 0 to 1."""
    rows, columns, _ = cells.shape
    height, width, _ = backdrop.pixels.shape
    seen = seen @ np.diag([1 / columns, 1 / rows, 1])
    steps = np.hypot(*_slopes(seen, columns / 2, rows / 2)) * (width, height)
    wide, high = (math.ceil(size / max(step, 1.0)) for size, step in zip((width, height), steps, strict=True))
    matrix = np.diag([wide, high, 1.0]) @ seen
    # Only the part that the cells see: an enlarged backdrop would have too many pixels.
    across, down = _seen(matrix, 0, columns, rows, wide), _seen(matrix, 1, columns, rows, high)
    corner = (down.start, across.start)
    picture = np.empty((len(down), len(across), 3), np.float32)
    _resample(backdrop, picture, threads, (high, wide), corner)
    in_parts(
        lambda start: place(picture, (high, wide), corner, matrix, start, min(start + ROWS, rows), cells),
        range(0, rows, ROWS),
        threads,
    )


def _slopes(matrix: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """How fast what a homography maps to moves with x and with y, at a point: two rows (u, v)."""
    u, v, depth = matrix @ (x, y, 1)
    return np.asarray((matrix[:2, :2] - np.outer((u, v), matrix[2, :2]) / depth).T / depth)


def _seen(matrix: NDArray[np.float64], axis: int, columns: int, rows: int, size: int) -> range:
    """The range of pixels along an axis of a picture that cells sample, with one more at each end for rounding.

    Parameters
    ----------
    matrix : (3, 3) float64
        From cells to pixels.
    axis : int
    columns, rows : int
        Size of the grid of cells.
    size : int
        Size of the picture along this axis.
    """
    corners = [matrix @ (x, y, 1) for x in (0, columns) for y in (0, rows)]
    places = [corner[axis] / corner[2] for corner in corners]
    first, end = (min(max(at, 0), size) for at in (math.floor(min(places)) - 2, math.floor(max(places)) + 3))
    return range(first, end)


@njit(nogil=True, cache=True)
def _light_at(
    image: NDArray[np.integer] | NDArray[np.float32],
    table: NDArray[np.float32] | None,
    y: int,
    x: int,
    channel: int,
) -> np.float32:
    """The linear light of a channel of a pixel; looked up here, so that integer pictures need no float copy."""
    if table is None:
        value: np.float32 = image[y, x, channel]
        return value
    light: np.float32 = table[image[y, x, channel]]
    last = image.shape[2] - 1
    if last & 1:  # the last channel is alpha
        light *= np.float32(image[y, x, last]) / np.float32(table.size - 1)
    return light


@njit(nogil=True, cache=True)
def _area_mean(
    image: NDArray[np.integer] | NDArray[np.float32],
    table: NDArray[np.float32] | None,
    grid: tuple[int, int],
    corner: tuple[int, int],
    start: int,
    stop: int,
    cells: NDArray[np.float32],
) -> None:
    """The mean of an image over each cell in part of a grid; the image is constant over each of its pixels.

    Parameters
    ----------
    image, table
        Those of a backdrop.
    grid : (int, int)
        Rows and columns of the grid that the image is stretched over.
    corner : (int, int)
        First row and column of the part.
    start, stop : int
        Rows of the part to compute.
    cells : (rows, columns, 3) float32
        The part; rows from ``start`` up to ``stop`` are written.
    """
    height, width, channels = image.shape
    rows, columns = grid
    colours = 3 if channels >= 3 else 1
    line = np.empty((width // columns + 2, colours), np.float32)  # sums over the rows of a cell's pixels
    for r in range(start, stop):
        top, bottom = (corner[0] + r) * height / rows, (corner[0] + r + 1) * height / rows
        for k in range(cells.shape[1]):
            left, right = (corner[1] + k) * width / columns, (corner[1] + k + 1) * width / columns
            first, end = int(left), min(int(np.ceil(right)), width)
            line[: end - first] = 0
            for y in range(int(top), min(int(np.ceil(bottom)), height)):
                share = np.float32((min(bottom, y + 1.0) - max(top, float(y))) / (bottom - top))
                for x in range(first, end):
                    for c in range(colours):
                        line[x - first, c] += share * _light_at(image, table, y, x, c)
            red = green = blue = np.float32(0)
            for x in range(first, end):
                share = np.float32((min(right, x + 1.0) - max(left, float(x))) / (right - left))
                red += share * line[x - first, 0]
                green += share * line[x - first, colours // 2]
                blue += share * line[x - first, colours - 1]
            cells[r, k, 0], cells[r, k, 1], cells[r, k, 2] = red, green, blue


@njit(nogil=True, cache=True)
def _halve(fine: NDArray[np.float32], start: int, stop: int, coarse: NDArray[np.float32]) -> None:
    """Some rows of the next coarser grid, with the weights [1, 3, 3, 1] / 8 along each axis."""
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
