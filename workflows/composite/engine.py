"""Composite C = S + X (rho T L), strip by strip: eq. 5 with X, the crosstalk from monitor to camera channels."""

from collections.abc import Callable
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.errors import OptionError
from storage.layout.mattes import Matte
from workflows.composite.depth import Rays, arrived_along
from workflows.composite.gather import gather
from workflows.composite.strips import LENGTH, Rows, Strip
from workflows.recovery.pyramid import Grids, Pyramid
from workflows.threads import in_parts

BAND = 1 << 19
"""Pixels that are composited at once where memory counts: 8 MiB of light and alpha."""


class Window(NamedTuple):
    """A rectangle of a matte, in pixels."""

    x: int
    y: int
    width: int
    height: int

    @classmethod
    def of(
        cls,
        matte: Matte,
        x: int = 0,
        y: int = 0,
        width: int | None = None,
        height: int | None = None,
    ) -> "Window":
        """A window of a matte; by default its size reaches to the edge.

        Raises
        ------
        OptionError
            If it does not lie inside the matte.
        """
        width = matte.width - x if width is None else width
        height = matte.height - y if height is None else height
        for name, at, size, most in (("x", x, width, matte.width), ("y", y, height, matte.height)):
            if at < 0 or size < 1 or at + size > most:
                crop = f"a crop from {name} = {at}" + (f", {size} pixels long," if 0 <= at < most else "")
                raise OptionError(
                    f"{crop} does not lie inside the matte of {matte.width} x {matte.height} pixels",
                    field=name,
                    limit=most,
                )
        return cls(x, y, width, height)

    def bands(self, block: int) -> list["Window"]:
        """Its bands from top to bottom, of some `BAND` pixels each, cut between rows of blocks."""
        step = max(BAND // self.width // block, 1) * block
        cuts = range((self.y // step + 1) * step, self.y + self.height, step)
        edges = pairwise((self.y, *cuts, self.y + self.height))
        return [Window(self.x, top, self.width, end - top) for top, end in edges]


def compose(
    matte: Matte,
    light: NDArray[np.float32],
    window: Window,
    read: Callable[[int, int], Strip],
    threads: int,
    rays: Rays | None = None,
) -> NDArray[np.float32]:
    """Composite a window of a matte over a backdrop.

    Parameters
    ----------
    matte : Matte
    light : (nodes + 1, 3) float32
        See `node_light`.
    window : Window
    read : callable
        Returns a strip by its block row and its number in the row, as `read_strip` does.
    threads : int
        Threads to use.
    rays : Rays, optional
        For a backdrop at another depth than the monitor.

    Returns
    -------
    (height, width, 4) float32
        Linear light and alpha, of the window's size. Alpha is 1 where the pixel was recovered; elsewhere all is 0.

    Raises
    ------
    Corrupt
        If ``read`` raises it.
    """
    pyramid = Pyramid.over(matte.columns, matte.rows)
    if light.shape != (pyramid.nodes + 1, 3):  # compiled code does not check bounds
        raise ValueError(f"light of shape {light.shape} is not that of a pyramid of {pyramid.nodes} nodes")
    picture = np.zeros((window.height, window.width, 4), np.float32)
    crosstalk = np.array(matte.attributes["crosstalk"], np.float32)
    grids = pyramid.arrays
    high, wide = matte.block, LENGTH
    strips = list(
        product(
            range(window.y // high, -(-(window.y + window.height) // high)),
            range(window.x // wide, -(-(window.x + window.width) // wide)),
        )
    )

    def one(which: int) -> None:
        row, number = strips[which]
        strip = read(row, number)
        top, left = row * high - window.y, number * wide - window.x
        if rays is not None:
            shift = rays.shift[row * high : (row + 1) * high, number * wide : (number + 1) * wide]
            seen = _seen_along(strip, light, crosstalk, grids, shift, rays.scale)
            to = picture[max(top, 0) : top + seen.shape[0], max(left, 0) : left + seen.shape[1]]
            to[:] = seen[max(-top, 0) :, max(-left, 0) :][: to.shape[0], : to.shape[1]]
            return
        _compose(
            strip.rows,
            strip.S,
            strip.rho,
            strip.recovered,
            strip.shared,
            light,
            crosstalk,
            top,
            left,
            picture,
        )

    in_parts(one, range(len(strips)), threads)
    return picture


def _seen_along(
    strip: Strip,
    light: NDArray[np.float32],
    crosstalk: NDArray[np.float32],
    grids: Grids,
    shift: NDArray[np.float32],
    scale: float,
) -> NDArray[np.float32]:
    """Composite a strip over a backdrop at another depth."""
    arrived = np.empty_like(strip.S)
    arrived_along(strip.rows, strip.shared, light, grids, shift, scale, arrived)
    alpha = strip.recovered[..., np.newaxis]
    return np.concatenate([alpha * (strip.S + (strip.rho * arrived) @ crosstalk.T), alpha], axis=2)


@njit(nogil=True, cache=True, fastmath={"contract"})
def _compose(
    rows: Rows,
    S: NDArray[np.float32],
    rho: NDArray[np.float32],
    recovered: NDArray[np.bool_],
    shared: NDArray[np.bool_],
    light: NDArray[np.float32],
    crosstalk: NDArray[np.float32],
    top: int,
    left: int,
    picture: NDArray[np.float32],
) -> None:
    """Composite the part of a strip that lies in the picture; its first pixel is at (top, left)."""
    height, width, _ = picture.shape
    count, first, step, code = rows
    row, entry, none = np.intp(0), np.intp(0), np.float32(0)
    for y in range(recovered.shape[0]):
        for x in range(recovered.shape[1]):
            red = green = blue = none
            end = entry + np.intp(count[y, x, 0])
            if end > entry:
                red, green, blue = gather(light, step, code, np.intp(first[row]), entry, end)
                row, entry = row + 1, end
            if not shared[y, x]:
                green = blue = none
                end = entry + np.intp(count[y, x, 1])
                if end > entry:
                    _, green, _ = gather(light, step, code, np.intp(first[row]), entry, end)
                    row, entry = row + 1, end
                end = entry + np.intp(count[y, x, 2])
                if end > entry:
                    _, _, blue = gather(light, step, code, np.intp(first[row]), entry, end)
                    row, entry = row + 1, end
            v, u = top + y, left + x
            if recovered[y, x] and 0 <= v < height and 0 <= u < width:
                red *= rho[y, x, 0]
                green *= rho[y, x, 1]
                blue *= rho[y, x, 2]
                for c in range(3):
                    picture[v, u, c] = S[y, x, c] + (
                        crosstalk[c, 0] * red + crosstalk[c, 1] * green + crosstalk[c, 2] * blue
                    )
                picture[v, u, 3] = 1
