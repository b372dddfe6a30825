"""Composite C = S + X (rho T L), strip by strip: eq. 5 with X, the crosstalk from monitor to camera channels."""

from collections.abc import Callable, Iterator
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
from workflows.images.resample import area_mean
from workflows.interruption import checkpoint
from workflows.recovery.pyramid import Grids, Pyramid
from workflows.threads import in_parts

BAND = 1 << 19
"""Pixels that are composited at once where memory counts: 8 MiB of light and alpha."""
SCALED_AT_ONCE = 64
"""Rows or columns."""
CUBIC = np.array([-9, 111, 29, -3], np.float32) / 128
"""Weights of four pixels in a row, for a place a quarter of a pixel after the second (Catmull and Rom)."""
SEEN = 1 / 64
"""Alpha below which the light of an interpolated pixel is not known."""


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
    for first in range(0, size, SCALED_AT_ONCE):
        checkpoint()
        yield slice(first, first + SCALED_AT_ONCE)
