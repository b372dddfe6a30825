"""Resample images: stretch them over a monitor, and average them over the cells of a grid."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", bound=np.generic)

# Values in a strip of a stretched axis.
_STRIP = 1 << 20


def smallest_grid(image: NDArray[Value]) -> NDArray[Value]:
    """Reduce an image to the coarsest regular grid on which it loses nothing.

    Parameters
    ----------
    image : (height, width, channels)

    Returns
    -------
    (rows, columns, channels)
        ``height`` is a whole multiple of ``rows``, and ``width`` of ``columns``.
    """
    for axis in (0, 1):
        other = tuple(a for a in range(3) if a != axis)
        edges = np.flatnonzero(np.any(np.diff(image, axis=axis) != 0, axis=other)) + 1
        step = int(np.gcd.reduce(np.append(edges, image.shape[axis])))
        image = image[::step] if axis == 0 else image[:, ::step]
    return image


def stretch(values: NDArray[Value], width: int, height: int) -> NDArray[Value]:
    """Stretch the values of a grid over a monitor, as the capture format defines it.

    Parameters
    ----------
    values : (rows, columns, channels)

    Returns
    -------
    (height, width, channels)
        Pixel (y, x) has the value of row ``y * rows // height`` and column ``x * columns // width``.
    """
    rows, columns, _ = values.shape
    if (rows, columns) == (height, width):
        return values
    x, y = np.arange(width) * columns // width, np.arange(height) * rows // height
    picture: NDArray[Value] = values.take(x, axis=1).take(y, axis=0)
    return picture


def on_grid(light: NDArray[np.float32], columns: int, rows: int) -> NDArray[np.float32]:
    """The mean light over each cell of a grid, repeated if the grid is a multiple of the light's own."""
    if columns % light.shape[1] == 0 and rows % light.shape[0] == 0:
        return light.repeat(rows // light.shape[0], axis=0).repeat(columns // light.shape[1], axis=1)
    return area_mean(light, columns, rows)


def area_mean(image: NDArray[np.float32], columns: int, rows: int) -> NDArray[np.float32]:
    """The mean of an image over each cell of a grid that it is stretched over.

    Parameters
    ----------
    image : (height, width, channels) float32

    Returns
    -------
    (rows, columns, channels) float32

    Notes
    -----
    The image is constant over each of its pixels. Its integral is sampled at the edges of the cells; differences of the
    integral are exact means for any ratio of sizes, including enlargement.
    """
    for axis, cells in ((0, rows), (1, columns)):
        n = image.shape[axis]
        if n == cells:
            continue
        if n % cells == 0:  # the usual case, in which summing a cell's pixels is faster
            whole_pixels = (*image.shape[:axis], cells, n // cells, *image.shape[axis + 1 :])
            # Over few values, `mean` takes ten times as long.
            sums = np.einsum(("ykxc->yxc", "yxkc->yxc")[axis], image.reshape(whole_pixels))
            image = sums / np.float32(n // cells)
            continue
        moved = np.moveaxis(image, axis, 0).astype(np.float64)
        whole = np.concatenate([np.zeros((1, *moved.shape[1:])), np.cumsum(moved, axis=0)])
        at = np.arange(cells + 1) * (n / cells)
        below = np.minimum(at.astype(np.intp), n - 1)
        part = (at - below).reshape(-1, 1, 1)
        integral = whole[below] + part * moved[below]
        image = np.moveaxis(np.diff(integral, axis=0) * (cells / n), 0, axis).astype(np.float32)
    return np.ascontiguousarray(image)


def stretched_mean(
    values: NDArray[np.float32],
    monitor: tuple[int, int],
    columns: int,
    rows: int,
    offset: tuple[int, int] = (0, 0),
) -> NDArray[np.float32]:
    """The mean over each cell of a grid of values that are stretched over a monitor, and rolled.

    Parameters
    ----------
    values : (height, width, channels) float32
    monitor : (int, int)
        Width and height in pixels.
    columns, rows : int
        The grid.
    offset : (int, int)
        Pixels x and y of the monitor that the stretched values are rolled back by.

    Returns
    -------
    (rows, columns, channels) float32
        As `area_mean` of the rolled result of `stretch`, but no array has all of the monitor's pixels: one axis after
        the other is stretched and averaged, in strips.
    """
    for axis, cells in ((0, rows), (1, columns)):
        pixels, n, across = monitor[1 - axis], values.shape[axis], values.shape[1 - axis]
        at = (np.arange(pixels) + offset[1 - axis]) % pixels * n // pixels
        means = []
        for strip in np.array_split(values, -(-pixels * across // _STRIP), axis=1 - axis):
            grid = (strip.shape[1], cells) if axis == 0 else (cells, strip.shape[0])
            means.append(area_mean(strip.take(at, axis=axis), *grid))
        values = np.concatenate(means, axis=1 - axis)
    return values
