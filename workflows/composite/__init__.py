"""Composite a matte over any backdrop."""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Matte
from workflows.composite.backdrops.backdrop import Backdrop, node_light
from workflows.composite.backdrops.placement import Placement
from workflows.composite.depth import Rays
from workflows.composite.engine import Window, compose
from workflows.composite.strips import Strip, read_strip
from workflows.threads import CORES


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
    """Composite a matte over a backdrop.

    Parameters
    ----------
    matte : Matte
    backdrop : Backdrop, or (h, w, 1 or 3) float32
        An array is linear light.
    placement : Placement, optional
        Where the backdrop stands, in the plane of the monitor.
    rays : Rays, optional
        For a backdrop at another depth than the monitor.
    window : Window, optional
        Part of the matte; by default all of it.
    read : callable, optional
        Returns strips, see `compose`; by default they are read from the store.
    threads : int
        Threads to use; the result does not depend on it.

    Returns
    -------
    (height, width, 4) float32
        Linear light and alpha: 1 where the pixel was recovered, 0 where it was left out.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    given = backdrop if isinstance(backdrop, Backdrop) else Backdrop(backdrop)
    light = light_on(matte, given, placement, threads)
    return compose(
        matte, light, window or Window.of(matte), read or partial(read_strip, matte), threads, rays
    )


def light_on(
    matte: Matte, backdrop: Backdrop, placement: Placement | None, threads: int
) -> NDArray[np.float32]:
    """The light of a backdrop on the cells of a matte's monitor, for `compose`.

    Returns
    -------
    (nodes + 1, 3) float32
        See `node_light`.
    """
    wide, high = matte.attributes["monitor"] if placement else (1, 1)
    return node_light(backdrop, matte.columns, matte.rows, threads, placement, (wide, high))
