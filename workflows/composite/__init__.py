"""Composites: a matte before any backdrop."""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte
from workflows.composite.backdrop import Backdrop, node_light
from workflows.composite.depth import Rays
from workflows.composite.engine import Window, compose
from workflows.composite.placement import Placement
from workflows.composite.strips import Strip, read_strip
from workflows.composite.threads import CORES


def composite(
    matte: Matte,
    backdrop: Backdrop | NDArray[np.float32],
    *,
    placement: Placement | None = None,
    rays: Rays | None = None,
    window: Window | None = None,
    read: Callable[[int, int], Strip] | None = None,
    threads: int = CORES,
) -> NDArray[np.float32]:
    """Put a matte before a backdrop.

    Parameters
    ----------
    matte : Matte
    backdrop : Backdrop, or (h, w, 1 or 3) float32
        The latter linear light.
    placement : Placement, optional
        Where the backdrop stands before the monitor's place.
    rays : Rays, optional
        How far behind it, or before it.
    window : Window, optional
        Of the matte; default all of it.
    read : callable, optional
        Where strips come from, as `compose` says; default the store.
    threads : int
        To share the work; the picture is the same.

    Returns
    -------
    (height, width, 4) float32
        Linear light, and in the last channel 1 where the pixel was recovered, 0 where the mask left it out.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    given = backdrop if isinstance(backdrop, Backdrop) else Backdrop(backdrop)
    wide, high = matte.attributes["monitor"] if placement else (1, 1)
    light = node_light(given, matte.columns, matte.rows, threads, placement, (wide, high))
    return compose(
        matte, light, window or Window.of(matte), read or partial(read_strip, matte), threads, rays
    )
