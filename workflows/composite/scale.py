"""Composites of other sizes than the matte's: averaged to smaller ones, interpolated to twice the size."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from workflows.images.resample import area_mean
from workflows.interruption import checkpoint

AT_ONCE = 64
"""Rows or columns that are scaled at a time."""
CUBIC = np.array([-9, 111, 29, -3], np.float32) / 128
"""Weights of four pixels in a row, for a place a quarter of a pixel after the second (Catmull and Rom)."""
SEEN = 1 / 64
"""Alpha below which the light of an interpolated pixel is not known."""


def shrink(picture: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Shrink a picture by averaging, so that its longer side has at most ``size`` pixels.

    Parameters
    ----------
    picture : (h, w, 4) float32
        Linear light and alpha. Transparent pixels have no weight.
    size : int
    """
    height, width, _ = picture.shape
    share = size / max(height, width)
    if share >= 1:
        return picture
    columns, rows = max(round(width * share), 1), max(round(height * share), 1)
    # Part by part, for averaging takes several times the memory of what it is given.
    narrow = np.empty((height, columns, 4), np.float32)
    for at in _parts(height):
        alpha = picture[at, :, 3:]
        weighted = np.concatenate([picture[at, :, :3] * alpha, alpha], axis=2)
        narrow[at] = area_mean(weighted, columns, len(weighted))
    small = np.empty((rows, columns, 4), np.float32)
    for at in _parts(columns):
        small[:, at] = area_mean(narrow[:, at], len(small[0, at]), rows)
    small[..., :3] /= np.maximum(small[..., 3:], np.float32(1e-6))
    return small


def double(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Make a picture twice as wide and high, by cubic interpolation; it may overshoot beside edges.

    Parameters
    ----------
    picture : (h, w, 4) float32
        Linear light and alpha. Transparent pixels have no weight.

    Returns
    -------
    (2 h, 2 w, 4) float32
    """
    height, width, _ = picture.shape
    wide = np.empty((height, 2 * width, 4), np.float32)
    for at in _parts(height):
        part = picture[at]
        weighted = part * np.where(np.arange(4) < 3, part[..., 3:], np.float32(1))
        wide[at] = _double_rows(weighted.swapaxes(0, 1)).swapaxes(0, 1)
    large = np.empty((2 * height, 2 * width, 4), np.float32)
    for at in _parts(2 * width):
        part = _double_rows(wide[:, at])
        alpha = part[..., 3:]
        is_seen = alpha > SEEN
        large[:, at, :3] = np.where(is_seen, part[..., :3] / np.where(is_seen, alpha, 1), 0)
        large[:, at, 3:] = np.where(is_seen, np.minimum(alpha, 1), 0)
    return large


def _double_rows(part: NDArray[np.float32]) -> NDArray[np.float32]:
    """A picture with twice the rows: each becomes one a quarter before and one a quarter after its place."""
    rows = len(part)
    padded = np.pad(part, ((2, 2), (0, 0), (0, 0)), "edge")
    doubled = np.empty((2 * rows, *part.shape[1:]), np.float32)
    for after, weights in ((0, CUBIC[::-1]), (1, CUBIC)):
        doubled[after::2] = sum(
            weight * padded[after + n : after + n + rows] for n, weight in enumerate(weights)
        )
    return doubled


def _parts(size: int) -> Iterator[slice]:
    for first in range(0, size, AT_ONCE):
        checkpoint()
        yield slice(first, first + AT_ONCE)
