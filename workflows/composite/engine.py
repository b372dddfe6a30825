"""C = S + X (rho T L) (eq. 5, and the crosstalk X between the monitor's and the camera's channels), strip by strip."""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.errors import OptionError
from storage.layout.mattes import Matte
from workflows.composite.depth import Rays, arrived_along
from workflows.composite.gather import gather
from workflows.composite.strips import LENGTH, Strip
from workflows.composite.threads import in_parts
from workflows.images.resample import area_mean
from workflows.recovery.pyramid import Grids, Pyramid


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
        """One that lies in a matte; what is left out of its size reaches to the edge.

        Raises
        ------
        OptionError
            If it does not lie in it.
        """
        width = matte.width - x if width is None else width
        height = matte.height - y if height is None else height
        for name, at, size, most in (("x", x, width, matte.width), ("y", y, height, matte.height)):
            if at < 0 or size < 1 or at + size > most:
                raise OptionError(
                    f"a crop from {name} = {at} on, {size} pixels long, does not lie in the matte, which has "
                    f"{matte.width} x {matte.height}",
                    field=name,
                    limit=most,
                )
        return cls(x, y, width, height)


def compose(
    matte: Matte,
    light: NDArray[np.float32],
    window: Window,
    read: Callable[[int, int], Strip],
    threads: int,
    rays: Rays | None = None,
) -> NDArray[np.float32]:
    """Put a window of a matte before a backdrop.

    Parameters
    ----------
    matte : Matte
    light : (nodes + 1, 3) float32
        As `node_light` makes it.
    window : Window
    read : callable
        Returns a strip by its block row and its number in it, as `read_strip` does.
    threads : int
        To share the work.
    rays : Rays, optional
        Of a backdrop at another depth than the monitor's.

    Returns
    -------
    (window's height, width, 4) float32
        Linear light, and in the last channel 1 where the pixel was recovered; 0 in all of them where it was not.

    Raises
    ------
    Corrupt
        If `read` does.
    """
    pyramid = Pyramid.over(matte.columns, matte.rows)
    assert light.shape == (pyramid.nodes + 1, 3)  # which compiled code reads without looking
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
            strip.S,
            strip.rho,
            strip.recovered,
            strip.shared,
            strip.count,
            strip.cell,
            strip.weight,
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
    """A strip before a backdrop at another depth."""
    arrived = np.empty_like(strip.S)
    arrived_along(strip.count, strip.shared, strip.cell, strip.weight, light, grids, shift, scale, arrived)
    alpha = strip.recovered[..., np.newaxis]
    return np.concatenate([alpha * (strip.S + (strip.rho * arrived) @ crosstalk.T), alpha], axis=2)


@njit(nogil=True, cache=True, fastmath={"contract"})
def _compose(
    S: NDArray[np.float32],
    rho: NDArray[np.float32],
    recovered: NDArray[np.bool_],
    shared: NDArray[np.bool_],
    count: NDArray[np.uint32],
    cell: NDArray[np.uint32],
    weight: NDArray[np.float32],
    light: NDArray[np.float32],
    crosstalk: NDArray[np.float32],
    top: int,
    left: int,
    picture: NDArray[np.float32],
) -> None:
    """Composite a strip, whose first pixel is at (top, left) of the picture, as far as it lies in it."""
    height, width, _ = picture.shape
    entry = np.intp(0)
    for y in range(recovered.shape[0]):
        for x in range(recovered.shape[1]):
            end = entry + np.intp(count[y, x, 0])
            red, green, blue = gather(light, cell, weight, entry, end)
            entry = end
            if not shared[y, x]:
                end = entry + np.intp(count[y, x, 1])
                _, green, _ = gather(light, cell, weight, entry, end)
                entry, end = end, end + np.intp(count[y, x, 2])
                _, _, blue = gather(light, cell, weight, entry, end)
                entry = end
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


def shrink(picture: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """A picture whose longer side has no more than some pixels, of which each is the mean over it.

    Parameters
    ----------
    picture : (h, w, 4) float32
        Linear light, and alpha: what has none counts for nothing.
    size : int
    """
    height, width, _ = picture.shape
    share = size / max(height, width)
    if share >= 1:
        return picture
    alpha = picture[..., 3:]
    small = area_mean(
        np.concatenate([picture[..., :3] * alpha, alpha], axis=2),
        max(round(width * share), 1),
        max(round(height * share), 1),
    )
    small[..., :3] /= np.maximum(small[..., 3:], np.float32(1e-6))
    return small
