"""Resample images: stretch them over a monitor, average them over cells, and shift them by parts of a pixel."""

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", bound=np.generic)

LANCZOS_LOBES = 3
"""Lobes on either side of the kernel that images are shifted with."""
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
    offset: tuple[int, int],
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


def between_samples(
    place: NDArray[np.floating], size: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """The samples of a row before and after each place, and the share of the latter, for linear interpolation.

    Beyond its ends the row of ``size`` samples goes on as the first and the last of them.

    Examples
    --------
    >>> before, after, share = between_samples(np.array([-3, 0.25, 2]), 3)
    >>> before.tolist(), after.tolist(), share.tolist()
    ([0, 0, 2], [1, 1, 2], [0.0, 0.25, 0.0])
    """
    place = np.clip(place, 0, size - 1)
    before = np.floor(place).astype(np.intp)
    return before, np.minimum(before + 1, size - 1), (place - before).astype(np.float32)


def shift_back(
    values: NDArray[np.float32], shift: Sequence[float], margin: int, *, magnitude: bool = False
) -> NDArray[np.float32]:
    """Shift an image back to where it should be.

    Parameters
    ----------
    values : (..., h, w, channels) float32
    shift : (float, float)
        x and y in pixels: what belongs at (y, x) is at (y + shift[1], x + shift[0]) of the image.
    margin : int
        Extra pixels of the image on each side, at least `LANCZOS_LOBES` and the shift, rounded up.
    magnitude : bool
        Whether values count by the magnitude of their weights, as where it matters which have a part in a sum.

    Returns
    -------
    (..., h - 2 margin, w - 2 margin, channels) float32

    Notes
    -----
    The kernel is Lanczos of three lobes, applied along one axis after the other. A value does not depend on the
    rectangle that it is in.
    """
    for axis, distance in ((-2, shift[0]), (-3, shift[1])):
        whole = math.floor(distance)
        taps = _lanczos(distance - whole)
        length = values.shape[axis] - 2 * margin
        values = _weighed(values, np.abs(taps) if magnitude else taps, axis, margin + whole, length)
    return values


def _lanczos(fraction: float) -> NDArray[np.float32]:
    """Weights of the neighbours ``1 - LANCZOS_LOBES`` to ``LANCZOS_LOBES`` for a place a part of a pixel away."""
    distance = np.arange(1 - LANCZOS_LOBES, LANCZOS_LOBES + 1) - fraction
    taps = np.sinc(distance) * np.sinc(distance / LANCZOS_LOBES)
    weights: NDArray[np.float32] = (taps / taps.sum()).astype(np.float32)
    return weights


def _weighed(
    values: NDArray[np.float32], taps: NDArray[np.float32], axis: int, first: int, length: int
) -> NDArray[np.float32]:
    """Weighted sums of neighbours along an axis, for ``length`` values from ``first`` on."""

    def neighbours(place: int) -> NDArray[np.float32]:
        inside = [slice(None)] * values.ndim
        inside[axis] = slice(place, place + length)
        return values[tuple(inside)]

    total = np.zeros_like(neighbours(first))
    for place, tap in enumerate(taps, start=first + 1 - LANCZOS_LOBES):
        total += tap * neighbours(place)
    return total
