"""Intervals of a composite, from the contrast of its backdrop: see `workflows.recovery.interval`."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte
from workflows.composite.backdrops.backdrop import Backdrop, node_light
from workflows.composite.backdrops.placement import Placement
from workflows.composite.engine import Window, compose
from workflows.composite.strips import Strip
from workflows.recovery.interval import Interval, local_contrast
from workflows.recovery.pyramid import Pyramid


def contrast_on(
    matte: Matte,
    light: NDArray[np.float32],
    backdrop: Backdrop,
    placement: Placement | None,
    threads: int,
) -> NDArray[np.float32]:
    """The contrast of a backdrop about the cells of a matte's monitor.

    Parameters
    ----------
    light : (nodes + 1, 3) float32
        Of the backdrop, see `light_on`.
    backdrop : Backdrop
        Float values are squared in place, to take no more memory.

    Returns
    -------
    (nodes + 1, 3) float32
        See `local_contrast`; laid out like light.
    """
    pixels, table = backdrop.pixels, backdrop.table
    squared = Backdrop(np.square(pixels, out=pixels)) if table is None else Backdrop(pixels, table**2)
    square = node_light(
        squared, matte.columns, matte.rows, threads, placement, tuple(matte.attributes["monitor"])
    )
    pyramid = Pyramid.over(matte.columns, matte.rows)
    return np.concatenate([local_contrast(pyramid, light[:-1], square[:-1]), light[-1:]])


def half_widths(
    matte: Matte,
    interval: Interval,
    light: NDArray[np.float32],
    contrast: NDArray[np.float32],
    window: Window,
    read: Callable[[int, int], Strip],
    threads: int,
) -> NDArray[np.float32]:
    """Half the widths of the intervals of a window's pixels and channels.

    Parameters
    ----------
    matte, light, window, read, threads
        As of `compose`.
    interval : Interval
    contrast : (nodes + 1, 3) float32
        See `contrast_on`.

    Returns
    -------
    (height, width, 4) float32
        In linear light, and alpha.

    Raises
    ------
    Corrupt
        If ``read`` raises it.
    """
    dark, bright = np.zeros_like(light), np.ones_like(light)
    picture, S, white, around = (
        compose(matte, each, window, read, threads) for each in (light, dark, bright, contrast)
    )
    colours = slice(None), slice(None), slice(3)
    S = S[colours]
    picture[colours] = interval.half_width(picture[colours], white[colours] - S, around[colours] - S)
    return picture
