"""Composites of a matte that is being recovered: its preview shows where there is nothing else yet."""

import numpy as np
from numpy.typing import NDArray

from workflows.composite.engine import Window
from workflows.composite.strips import Blocks
from workflows.images.resample import between_samples


def window_of_preview(window: Window, spacing: int, width: int, height: int) -> Window:
    """The part of a preview of some width and height that `enlarge` needs for a window of the frame."""
    first_x, last_x = _between(np.array([window.x, window.x + window.width - 1]), spacing, width)[:2]
    first_y, last_y = _between(np.array([window.y, window.y + window.height - 1]), spacing, height)[:2]
    x, y = int(first_x[0]), int(first_y[0])
    return Window(x, y, int(last_x[1]) - x + 1, int(last_y[1]) - y + 1)


def enlarge(
    small: NDArray[np.float32], part: Window, window: Window, spacing: int, width: int, height: int
) -> NDArray[np.float32]:
    """Enlarge a composite of a preview to a window of the frame, by linear interpolation.

    A composite is linear in S, rho T: this is the composite of a matte that is interpolated.

    Parameters
    ----------
    small : (h, w, 4) float32
        Linear light and alpha.
    part : Window
        That it shows of the preview, as from `window_of_preview`.
    window : Window
    spacing : int
    width, height : int
        Of the preview.

    Returns
    -------
    (window.height, window.width, 4) float32
        Alpha is 1 where most of the light is from pixels that were recovered, and elsewhere all is 0.
    """
    picture = small * np.where(np.arange(4) < 3, small[..., 3:], 1)
    for axis, first, count, size, start in (
        (0, window.y, window.height, height, part.y),
        (1, window.x, window.width, width, part.x),
    ):
        before, after, share = _between(np.arange(first, first + count), spacing, size)
        share = share[:, np.newaxis, np.newaxis] if axis == 0 else share[:, np.newaxis]
        picture = picture.take(before - start, axis) * (1 - share) + picture.take(after - start, axis) * share
    alpha = picture[..., 3:]
    is_there = alpha > 0.5
    picture[..., :3] = np.where(is_there, picture[..., :3] / np.maximum(alpha, 0.5), 0)
    picture[..., 3:] = is_there
    return picture


def put_behind(
    picture: NDArray[np.float32], enlarged: NDArray[np.float32], window: Window, done: Blocks, block: int
) -> None:
    """Put an enlarged preview where blocks of a matte are not done; `picture` is written.

    Parameters
    ----------
    picture, enlarged : (h, w, 4) float32
        Of the window.
    window : Window
    done : set of (int, int)
    block : int
        Edge of a block.
    """
    rows = np.arange(window.y, window.y + window.height) // block
    columns = np.arange(window.x, window.x + window.width) // block
    is_done = np.zeros((rows[-1] + 1, columns[-1] + 1), bool)
    for row, column in done:
        if row < is_done.shape[0] and column < is_done.shape[1]:
            is_done[row, column] = True
    np.copyto(picture, enlarged, where=~is_done[rows[:, np.newaxis], columns][..., np.newaxis])


def _between(
    at: NDArray[np.integer], spacing: int, size: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """The pixels of a preview before and after places along an axis of the frame, and the share of the latter."""
    return between_samples((at - spacing // 2) / spacing, size)
