"""The rays that a matte's pixels see, for a backdrop at another depth than the monitor.

T says where a pixel's light left the monitor, but not at which angle. A second matte of the same object and camera,
with the monitor at another distance, gives the ray through both positions. With one matte, the ray is assumed to start
where the camera's line of sight meets the plane through the object, perpendicular to the camera's axis. That is right
for thin objects; for thick ones it is off by how far light moves sideways inside them.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.errors import Conflict
from storage.layout.mattes import Matte
from workflows.interruption import checkpoint
from workflows.mattes.lobes import block_lobes
from workflows.recovery.pyramid import Grids
from workflows.threads import in_parts

LOBES = 3
"""Lobes of a pixel that are fitted; the heaviest is used."""
DIRECT = 0.9
"""A pixel may see the monitor directly if its heaviest lobe has at least this share of its light."""
NEAR = 0.004
"""How far such a pixel may deviate from the common perspective, in widths of the monitor."""
STRAY = 0.1
"""How far a ray may deviate from those around it in the object's plane, in widths of the monitor."""
MIN_DIRECT = 0.02
"""Share of the recovered pixels that must see the monitor directly to find the camera's perspective."""
Places = NDArray[np.float32]
"""(height, width, 4) float32: the heaviest lobe of every pixel, see `places_of`."""


@dataclass(frozen=True)
class Rays:
    """Where pixels see a backdrop at another depth.

    A pixel that saw the monitor at p sees the backdrop at ``shift + scale p``, both in widths and heights of the
    monitor from its top left. The backdrop has the size of the monitor, and is centred on the same axis.

    Attributes
    ----------
    shift : (height, width, 2) float32
    scale : float
    """

    shift: NDArray[np.float32]
    scale: float


def places_of(matte: Matte, threads: int) -> Places:
    """The heaviest lobe of every pixel.

    Returns
    -------
    (height, width, 4) float32
        Its centre, in widths and heights of the monitor from the top left; its mean standard deviation, in widths; and
        its share of the light, which is 0 where nothing was recovered.
    """
    places = np.zeros((matte.height, matte.width, 4), np.float32)
    blocks = list(product(range(matte.block_rows), range(matte.block_columns)))

    def one(number: int) -> None:
        lobe = block_lobes(matte, matte.read(*blocks[number]), LOBES)[:, :, 0]
        at = places[matte.span(*blocks[number])]
        at[..., 3] = lobe[..., 2:5].mean(axis=2)
        at[..., 0], at[..., 1] = lobe[..., 0], np.where(at[..., 3] > 0, 1 - lobe[..., 1], 0)
        at[..., 2] = np.sqrt(lobe[..., 5] * lobe[..., 6])

    in_parts(one, range(len(blocks)), threads)
    return places


def from_two(first: Places, second: Places, distances: tuple[float, float], depth: float) -> Rays:
    """Rays through the positions that two mattes saw.

    Parameters
    ----------
    first, second : (height, width, 4) float32
        See `places_of`; the first is the matte to composite.
    distances : (float, float)
        From the object to the monitor in each of them, in any unit.
    depth : float
        From the object to the backdrop, in the same unit.

    Raises
    ------
    Conflict
        If too few pixels were recovered in both.

    Notes
    -----
    The ray through both positions meets the plane of the object, at distance 0, in ``(d2 p1 - d1 p2) / (d2 - d1)``.
    Where that is far from the rays of other pixels, the two mattes saw different light, such as a reflection that
    misses the farther monitor. An affine map of the frame, fitted to the other pixels, is then used instead.
    """
    near, far = distances
    through = (far * first[..., :2] - near * second[..., :2]) / np.float32(far - near)
    y, x = np.mgrid[: through.shape[0], : through.shape[1]].astype(np.float32) / max(through.shape[:2])
    frame = np.stack([x, y, np.ones_like(x)], axis=2)
    fits = (first[..., 3] > 0) & (second[..., 3] > 0)
    if np.count_nonzero(fits) < 16:
        raise Conflict("too few pixels were recovered in both mattes to find their rays")
    for _ in range(10):
        checkpoint()
        common = frame @ np.linalg.lstsq(frame[fits], through[fits], rcond=None)[0]
        off = np.hypot(*np.moveaxis(through - common, 2, 0))
        near_enough = max(STRAY, 5 * float(np.median(off[fits])))
        fits = (first[..., 3] > 0) & (second[..., 3] > 0) & (off < near_enough)
    return _through(np.where(fits[..., np.newaxis], through, common), depth / near)


def from_one(places: Places, aspect: float, distance: float, camera: float, depth: float) -> Rays:
    """Rays through the points where the camera's lines of sight meet the plane of the object.

    Parameters
    ----------
    places : (height, width, 4) float32
        See `places_of`.
    aspect : float
        Height of the monitor as a share of its width.
    distance, camera, depth : float
        From the object to the monitor, to the camera and to the backdrop, in one unit.

    Raises
    ------
    Conflict
        If too few pixels see the monitor directly to find the camera's perspective.

    Notes
    -----
    The camera's perspective is the homography between its pixels and the positions on the monitor that they see beside
    the object. The camera's axis is assumed to pass through the middle of the frame.
    """
    sight = _perspective(places, aspect)
    height, width = sight.shape[:2]
    foot = sight[(height - 1) // 2 : height // 2 + 1, (width - 1) // 2 : width // 2 + 1].mean(axis=(0, 1))
    through = foot + (sight - foot) * np.float32(camera / (camera + distance))
    return _through(through, depth / distance)


def _through(place: NDArray[np.floating], away: float) -> Rays:
    """Rays through positions ``place`` of the object's plane, to ``away`` times the monitor's distance."""
    return Rays((place * (1 - away)).astype(np.float32), away)


def _perspective(places: Places, aspect: float) -> NDArray[np.float32]:
    """Where on the monitor each pixel would look without the object, (height, width, 2)."""
    height, width, _ = places.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    across, down = (2 * x + 1) / width - 1, (2 * y + 1) / height - 1
    seen = places[..., :2].astype(np.float64)
    sharp = places[..., 3] > DIRECT
    candidates = sharp & (places[..., 2] < 2 * np.median(places[..., 2][sharp])) if sharp.any() else sharp
    # Start with the pixels at the edge of the frame, then add all that fit the same perspective.
    fits = candidates & (np.maximum(np.abs(across), np.abs(down)) > 0.9)
    least = max(MIN_DIRECT * np.count_nonzero(places[..., 3]), 16)
    for _ in range(10):
        checkpoint()
        if np.count_nonzero(fits) < least:
            raise Conflict(
                "too little of the monitor is seen directly beside the object to find the camera's perspective: film "
                "it with some of the bare monitor in the frame and no mask, or give a second matte at another distance"
            )
        h = _homography(across[fits], down[fits], seen[fits])
        scale = h[2, 0] * across + h[2, 1] * down + h[2, 2]
        sight = np.stack([h[k, 0] * across + h[k, 1] * down + h[k, 2] for k in (0, 1)], axis=2)
        sight /= scale[..., np.newaxis]
        off = np.hypot(*np.moveaxis((sight - seen) * (1, aspect), 2, 0))
        now = candidates & (off < max(NEAR, float(np.median(off[fits]))))
        if (now == fits).all():
            break
        fits = now
    return np.asarray(sight, np.float32)


def _homography(
    x: NDArray[np.float64], y: NDArray[np.float64], seen: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The (3, 3) homography from (x, y, 1) to ``seen`` (n, 2), by linear least squares; its last entry is 1."""
    u, v = seen.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=1),
        ]
    )
    found, *_ = np.linalg.lstsq(rows, np.concatenate([u, v]), rcond=None)
    return np.append(found, 1.0).reshape(3, 3)


@njit(nogil=True, cache=True)
def arrived_along(
    rows_of_strip: tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint16], NDArray[np.uint16]],
    shared: NDArray[np.bool_],
    light: NDArray[np.float32],
    grids: Grids,
    shift: NDArray[np.float32],
    scale: float,
    arrived: NDArray[np.float32],
) -> None:
    """Compute T L of a strip for a backdrop at another depth, in units of its rows.

    Parameters
    ----------
    rows_of_strip : tuple
        Its `count`, `first`, `step` and `code`.
    shared : (h, w) bool
        The strip's.
    light : (nodes + 1, 3) float32
        Light of the backdrop as if it stood where the monitor did.
    grids : Grids
        Grids of the pyramid.
    shift : (h, w, 2) float32
        `Rays.shift` of the strip's pixels.
    scale : float
        `Rays.scale`.
    arrived : (h, w, 3) float32
        Output.

    Notes
    -----
    A node that appears larger by ``scale`` is looked up on a coarser level, interpolating between two grids and between
    the nodes of each.
    """
    columns, rows, starts = grids
    count, first, step, code = rows_of_strip
    entry, number, levels = 0, 0, len(columns)
    seen, coarser = np.empty(3, np.float32), np.log2(scale)
    for y in range(shared.shape[0]):
        for x in range(shared.shape[1]):
            arrived[y, x] = 0
            for channel in range(3):
                cell = 0
                if count[y, x, channel] > 0:
                    cell = int(first[number])
                    number += 1
                for _ in range(count[y, x, channel]):
                    cell += int(step[entry])
                    node, level = cell, 0
                    while node >= starts[level + 1]:
                        level += 1
                    row, column = divmod(node - starts[level], columns[level])
                    u = (column + 0.5) * 2.0**level / columns[0] * scale + shift[y, x, 0]
                    v = (row + 0.5) * 2.0**level / rows[0] * scale + shift[y, x, 1]
                    seen[:] = 0
                    if 0 <= u < 1 and 0 <= v < 1:
                        at = min(max(level + coarser, 0.0), levels - 1.0)
                        lower = min(int(at), levels - 1)
                        share = np.float32(at - lower)
                        _look_up(light, grids, lower, u, v, 1 - share, seen)
                        if share > 0:
                            _look_up(light, grids, lower + 1, u, v, share, seen)
                    w = np.float32(code[entry])
                    if shared[y, x]:
                        for c in range(3):
                            arrived[y, x, c] += w * seen[c]
                    else:
                        arrived[y, x, channel] += w * seen[channel]
                    entry += 1


@njit(nogil=True, cache=True)
def _look_up(
    light: NDArray[np.float32],
    grids: Grids,
    level: int,
    u: float,
    v: float,
    share: float,
    seen: NDArray[np.float32],
) -> None:
    """Add a share of the light at a point of a grid, interpolated between its nodes."""
    columns, rows, starts = grids
    wide, high, first = columns[level], rows[level], starts[level]
    x = min(max(u * columns[0] / 2.0**level - 0.5, 0.0), wide - 1.0)
    y = min(max(v * rows[0] / 2.0**level - 0.5, 0.0), high - 1.0)
    i, j = int(x), int(y)
    a, b = x - i, y - j
    p, q = min(i + 1, wide - 1), min(j + 1, high - 1)
    for c in range(3):
        upper = light[first + j * wide + i, c] * (1 - a) + light[first + j * wide + p, c] * a
        lower = light[first + q * wide + i, c] * (1 - a) + light[first + q * wide + p, c] * a
        seen[c] += np.float32(share * (upper * (1 - b) + lower * b))
