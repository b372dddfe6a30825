"""The rays that a matte's pixels see, for a backdrop at another depth than the monitor.

T says where a pixel's light left the monitor, but not at which angle. A second matte of the same object and camera,
with the monitor at another distance, gives the ray through both positions. With one matte, the ray is assumed to start
where the camera's line of sight meets the plane through the object, perpendicular to the camera's axis. That is right
for thin objects; for thick ones it is off by how far light moves sideways inside them.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from storage.errors import Conflict
from workflows.composite.strips import Rows
from workflows.interruption import checkpoint
from workflows.mattes.perspective import Places, find_perspective, in_frame, sights
from workflows.recovery.pyramid import Grids

STRAY = 0.1
"""How far a ray may deviate from those around it in the object's plane, in widths of the monitor."""


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


def from_two(first: Places, second: Places, distances: tuple[float, float], depth: float) -> Rays:
    """Rays through the positions that two mattes saw.

    Parameters
    ----------
    first, second : (height, width, 4) float32
        See `workflows.mattes.perspective.places_of`; the first is the matte to composite.
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
        See `workflows.mattes.perspective.places_of`.
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
    height, width, _ = places.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    across, down = in_frame(y, x, height, width)
    perspective = find_perspective(places, across, down, aspect)
    if perspective is None:
        raise Conflict(
            "too little of the monitor is seen directly beside the object to find the camera's perspective: film it "
            "with some of the bare monitor in the frame and no mask, or give a second matte at another distance"
        )
    sight = sights(perspective, across, down).astype(np.float32)
    foot = sight[(height - 1) // 2 : height // 2 + 1, (width - 1) // 2 : width // 2 + 1].mean(axis=(0, 1))
    through = foot + (sight - foot) * np.float32(camera / (camera + distance))
    return _through(through, depth / distance)


def _through(place: NDArray[np.floating], away: float) -> Rays:
    """Rays through positions ``place`` of the object's plane, to ``away`` times the monitor's distance."""
    return Rays((place * (1 - away)).astype(np.float32), away)


@njit(nogil=True, cache=True)
def arrived_along(
    rows_of_strip: Rows,
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
    rows_of_strip : Rows
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
