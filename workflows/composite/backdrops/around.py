"""The backdrop around the glass: what a mask left out shows it, as if the frame saw the whole monitor."""

import numpy as np
from numpy.typing import NDArray

from workflows.composite.backdrops.backdrop import Backdrop, frame_light
from workflows.composite.backdrops.placement import Placement
from workflows.composite.engine import Window


def put_around(
    picture: NDArray[np.float32],
    backdrop: Backdrop,
    window: Window,
    frame: tuple[int, int],
    monitor: tuple[int, int],
    placement: Placement | None,
    threads: int,
) -> NDArray[np.float32]:
    """Put the backdrop where a composite is transparent.

    Parameters
    ----------
    picture : (height, width, 4) float32
        Linear light and alpha of the window; changed in place.
    backdrop : Backdrop
    window : Window
    frame : (int, int)
        Width and height of the matte. The backdrop is stretched over it.
    monitor : (int, int)
        Width and height of the monitor, for a backdrop with a placement.
    placement : Placement, optional
    threads : int

    Returns
    -------
    (height, width, 4) float32
        The picture, opaque. Within a pixel of the edge both are mixed, so that it shows no steps.
    """
    alpha = picture[..., 3:]
    if (alpha == 1).all():
        return picture
    behind = frame_light(backdrop, *frame, threads, placement, monitor)
    behind = behind[window.y : window.y + window.height, window.x : window.x + window.width]
    alpha = alpha * _blurred(alpha)
    picture[..., :3] *= alpha
    picture[..., :3] += (1 - alpha) * behind
    picture[..., 3] = 1
    return picture


def _blurred(alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """The mean over each pixel and its eight neighbours."""
    for axis in (0, 1):
        size = alpha.shape[axis]
        wide = np.pad(alpha, [(1, 1) if axis == other else (0, 0) for other in range(3)], mode="edge")
        before, at, after = (np.take(wide, range(k, k + size), axis) for k in range(3))
        alpha = (before + at + after) / np.float32(3)
    return alpha
