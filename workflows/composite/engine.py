"""C = S + X (rho T L) (eq. 5, and the crosstalk X between the monitor's and the camera's channels), block by block."""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.errors import OptionError
from storage.mattes import Block, Matte
from workflows.composite.prefetch import prefetch
from workflows.composite.rays import Rays, arrived_along
from workflows.composite.threads import in_parts
from workflows.grids import area_mean
from workflows.recovery.pyramid import Pyramid

AHEAD = 96
"""Cells of T by which their light is asked for before it is used."""


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
    read: Callable[[int, int], Block | None],
    threads: int,
    rays: Rays | None = None,
) -> NDArray[np.float32]:
    """Put a window of a matte before a backdrop.

    Parameters
    ----------
    matte : Matte
    light : (nodes, 3) float32
        As `node_light` makes it.
    window : Window
    read : callable
        Returns the block in a block row and a block column; None if there is none yet.
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
    picture = np.zeros((window.height, window.width, 4), np.float32)
    crosstalk = np.array(matte.attributes["crosstalk"], np.float32)
    edge = matte.block
    blocks = list(
        product(
            range(window.y // edge, -(-(window.y + window.height) // edge)),
            range(window.x // edge, -(-(window.x + window.width) // edge)),
        )
    )

    def one(number: int) -> None:
        row, column = blocks[number]
        block = read(row, column)
        if block is None:
            return
        if rays is not None:
            _compose_along(matte, row, column, block, light, crosstalk, rays, window, picture)
            return
        _compose(
            block.S,
            block.rho,
            block.recovered,
            block.shared,
            block.count,
            block.cell,
            block.weight,
            light,
            crosstalk,
            row * edge - window.y,
            column * edge - window.x,
            picture,
        )

    in_parts(one, range(len(blocks)), threads)
    return picture


def _compose_along(
    matte: Matte,
    row: int,
    column: int,
    block: Block,
    light: NDArray[np.float32],
    crosstalk: NDArray[np.float32],
    rays: Rays,
    window: Window,
    picture: NDArray[np.float32],
) -> None:
    """Composite a block before a backdrop at another depth, as far as it lies in the window."""
    at = matte.span(row, column)
    arrived = np.empty_like(block.S)
    grids = Pyramid.over(matte.columns, matte.rows).arrays
    rows = (block.count, block.shared, block.cell, block.weight)
    arrived_along(*rows, light, grids, rays.shift[at], rays.scale, arrived)
    alpha = block.recovered[..., np.newaxis]
    seen = np.concatenate([alpha * (block.S + (block.rho * arrived) @ crosstalk.T), alpha], axis=2)
    top, left = at[0].start - window.y, at[1].start - window.x
    to = picture[max(top, 0) : top + seen.shape[0], max(left, 0) : left + seen.shape[1]]
    to[:] = seen[max(-top, 0) :, max(-left, 0) :][: to.shape[0], : to.shape[1]]


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
    """Composite a block, whose first pixel is at (top, left) of the picture, as far as it lies in it."""
    height, width, _ = picture.shape
    values, last = light.reshape(-1), cell.size - 1
    entry = 0
    for y in range(recovered.shape[0]):
        for x in range(recovered.shape[1]):
            red = green = blue = np.float32(0)
            if shared[y, x]:
                for _ in range(count[y, x, 0]):
                    # The light of a monitor is larger than a core's cache, and cells are known long before.
                    prefetch(values, np.intp(cell[min(entry + AHEAD, last)]) * 3)
                    k, w = cell[entry], weight[entry]
                    red += w * light[k, 0]
                    green += w * light[k, 1]
                    blue += w * light[k, 2]
                    entry += 1
            else:
                for _ in range(count[y, x, 0]):
                    red += weight[entry] * light[cell[entry], 0]
                    entry += 1
                for _ in range(count[y, x, 1]):
                    green += weight[entry] * light[cell[entry], 1]
                    entry += 1
                for _ in range(count[y, x, 2]):
                    blue += weight[entry] * light[cell[entry], 2]
                    entry += 1
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
