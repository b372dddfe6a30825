"""Where the object stands in a capture without a mask: all that is neither bare monitor nor room.

A bare pixel sees one place of the monitor, the one where the camera looks beside the object, about as brightly as the
bare pixels around it do. The preview of a matte shows roughly where the object is, and only what is near it is
recovered. Of each of these pixels its own T then says whether it is bare.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_dilation,
    binary_erosion,
    binary_opening,
    gaussian_filter,
    label,
    map_coordinates,
    median_filter,
)

from storage.errors import Conflict
from storage.layout.mattes import Block, Matte
from workflows.mattes.lobes import Gridded, transport_of
from workflows.mattes.perspective import DIRECT, LEAST, NEAR, Sight, between, find_sight, lengths, places_of
from workflows.recovery.pyramid import Grids, Pyramid
from workflows.threads import CORES

MARGIN = 2
"""Pixels of the preview by which the object's edges may be off in it."""
EDGE = 3
"""Pixels of the frame by which the monitor's edges may be off. At its own edges a frame that drifted is made up."""
REACH = 4
"""How far the light of a bare pixel reaches on the monitor, in pixels of the frame."""
DEVIATIONS = 6
"""How far a bare pixel may deviate from where the camera looks, in medians of all deviations."""
LEAST_DEVIATION = 5e-4
"""The same at least, in widths of the monitor."""
ALIKE = 0.06
"""How far rho of a bare pixel may be from that of the bare pixels around it, as a share."""
SPREAD = 1 / 32
"""Standard deviation with which rho of bare pixels is averaged, in lengths of the frame's larger side."""
FAINTEST = 0.02
"""Least rho of a channel of the bare monitor, as a share of that of the brightest: a camera may not see one at all."""
LIT = 0.1
"""Beyond the monitor's edges the object has at least this share of the bare monitor's rho. A table mirrors less."""
LEAST_PART = 0.02
"""Parts that are smaller than this share of the largest are not the object."""
LEAST_HOLE = 0.05
"""Bare areas that the object encloses, and that are smaller than this share of it, belong to it: a lens looks straight
through its middle."""
Bools = NDArray[np.bool_]
Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Span = tuple[slice, slice]


@dataclass(frozen=True)
class CutOut:
    """Where the object of a capture stands.

    Attributes
    ----------
    spacing : int
        Rows and columns of the frame from one of the preview to the next.
    sight : Sight
    aspect : float
        Height of the monitor as a share of its width.
    pitch : float
        From one pixel of the frame to the next, in widths of the monitor.
    deviation : float
        See `DEVIATIONS`; in widths of the monitor.
    bare_rho : (h, w) float32
        Mean rho of the bare monitor around each pixel of the preview; 0 where there is none.
    bare : (3,) float64
        rho of the bare monitor around the object.
    object : (h, w) bool
        The pixels of the preview that show the object.
    """

    spacing: int
    sight: Sight
    aspect: float
    pitch: float
    deviation: float
    bare_rho: Floats
    bare: Doubles
    object: Bools

    def wanted(self, span: Span) -> Bools:
        """The pixels of a rectangle of the frame that are worth recovering: near the object, or between its parts."""
        return self._enlarged(self._area, span)

    # What follows holds for the frame: it is worked out once, not for each block.

    @cached_property
    def _area(self) -> Bools:
        return np.asarray(binary_dilation(between(self.object), iterations=MARGIN))

    @cached_property
    def _near(self) -> Bools:
        return np.asarray(binary_dilation(self.object, iterations=MARGIN))

    @cached_property
    def _within(self) -> Bools:
        return np.asarray(binary_erosion(self.object, border_value=1))

    @cached_property
    def _lit(self) -> float:
        return _least_lit(self.bare_rho)

    def cut(self, block: Block, matte: Gridded, span: Span) -> Block:
        """A block of a matte without the pixels that do not show the object."""
        rho = block.rho.mean(axis=2)
        y, x = np.mgrid[span].astype(np.float64)
        sight = self.sight.at(y, x)
        off = off_sight(block, matte, sight, self.pitch, self.aspect)
        is_inside = _is_inside(self.sight, sight, y, x, self.pitch)
        at = [(place - self.spacing // 2) / self.spacing for place in (y, x)]
        bare_rho = map_coordinates(self.bare_rho, at, order=1, mode="nearest")
        is_bare = (off < _tolerance(self.deviation, matte)) & _is_alike(rho, bare_rho)
        near, within = self._enlarged(self._near, span), self._enlarged(self._within, span)
        seen_through = ~is_bare & (is_inside | (near & (rho > self._lit)))
        kept = block.recovered & median_filter(block.recovered & (within | seen_through), 3)
        entries = np.repeat(kept.ravel(), block.count.sum(axis=2, dtype=np.intp).ravel())
        channels = kept[..., np.newaxis]
        return Block(
            block.S * channels,
            block.rho * channels,
            np.where(kept, block.error, np.float32(0)),
            kept,
            block.shared & kept,
            block.count * channels,
            block.cell[entries],
            block.weight[entries],
        )

    def _enlarged(self, small: Bools, span: Span) -> Bools:
        """What an array of the preview's size says of a rectangle of the frame."""
        rows, columns = (
            np.minimum(np.arange(part.start, part.stop) // self.spacing, size - 1)
            for part, size in zip(span, small.shape, strict=True)
        )
        return small[np.ix_(rows, columns)]


def find_object(preview: Matte, spacing: int, height: int, width: int) -> CutOut:
    """Find the object in the preview of a matte.

    Parameters
    ----------
    preview : Matte
        All of whose pixels were recovered, whatever it shows of them.
    spacing : int
        See `workflows.mattes.preview`.
    height, width : int
        Of the frame.

    Raises
    ------
    Conflict
        If it can't be found; says why.
    """
    y, x = (
        place.astype(np.float64) * spacing + spacing // 2
        for place in np.mgrid[: preview.height, : preview.width]
    )
    across, down = preview.attributes["monitor"]
    aspect = down / across
    sight = find_sight(places_of(preview, CORES), y, x, (height, width), aspect)
    if sight is None:
        raise Conflict("too little of the monitor is seen directly beside it")
    seen = sight.at(y, x)
    pitch = float(np.median(lengths(np.diff(seen, axis=1), aspect))) / spacing
    is_inside, colours = _is_inside(sight, seen, y, x, pitch), preview.layer("rho")
    rho = colours.mean(axis=2)
    off = np.empty((preview.height, preview.width), np.float32)
    for row, column in product(range(preview.block_rows), range(preview.block_columns)):
        span = preview.span(row, column)
        off[span] = off_sight(preview.read(row, column), preview, seen[span], pitch, aspect)
    near = is_inside & (off < NEAR)
    if np.count_nonzero(near) < LEAST:
        raise Conflict("too little of the monitor is seen directly beside it")
    deviation = max(LEAST_DEVIATION, DEVIATIONS * float(np.median(off[near])))
    straight = off < _tolerance(deviation, preview)
    bare_rho = _around(rho, straight)
    for _ in range(2):  # without what is brighter or darker than the others
        bare_rho = _around(rho, straight & _is_alike(rho, bare_rho))
    is_bare = straight & _is_alike(rho, bare_rho)
    found = _largest_parts(~is_bare & (is_inside | (rho > _least_lit(bare_rho))), is_inside)
    # Of the bare pixels around the object alone: towards a frame's edges lenses darken.
    near = is_bare & binary_dilation(found, iterations=round(2 * SPREAD * max(found.shape)))
    bare = np.median(colours[near if near.any() else is_bare], axis=0).astype(np.float64)
    bare = np.maximum(bare, FAINTEST * bare.max())
    return CutOut(spacing, sight, aspect, pitch, deviation, bare_rho, bare, found)


def _is_inside(sight: Sight, seen: Doubles, y: Doubles, x: Doubles, pitch: float) -> Bools:
    """Whether pixels look at the monitor beside the object, well within its edges and the frame's."""
    edge = EDGE * pitch
    of_monitor = ((seen > edge) & (seen < 1 - edge)).all(axis=-1)
    of_frame = (np.minimum(y, sight.height - 1 - y) >= EDGE) & (np.minimum(x, sight.width - 1 - x) >= EDGE)
    return np.asarray(of_monitor & of_frame)


def _is_alike(rho: Floats, bare_rho: Floats) -> Bools:
    """Whether rho is as that of bare pixels around."""
    return np.asarray(np.abs(rho - bare_rho) < ALIKE * bare_rho)


def _least_lit(bare_rho: Floats) -> float:
    """The rho from which on pixels show light of the monitor."""
    return LIT * float(np.median(bare_rho[bare_rho > 0]))


def _around(rho: Floats, is_bare: Bools) -> Floats:
    """The mean rho of bare pixels around each pixel; 0 where there are none."""
    sigma = SPREAD * max(rho.shape)
    weight, total = (gaussian_filter(v.astype(np.float32), sigma) for v in (is_bare, rho * is_bare))
    return np.where(weight > 0.01, total / np.maximum(weight, 0.01), 0).astype(np.float32)


def _tolerance(deviation: float, matte: Gridded) -> float:
    """How far the light of a bare pixel may be from where the camera looks, in widths of the monitor."""
    return max(deviation, 0.5 / matte.columns)  # a method without lobes knows whole cells only


def _largest_parts(seen: Bools, is_inside: Bools) -> Bools:
    """The parts of a picture that are large enough, without small holes.

    The edges of the monitor and the border around the patterns, which are seen beyond it, are thin or stand alone.
    """
    seen = median_filter(seen, 3)
    parts, _ = label(np.where(is_inside, seen, binary_opening(seen)))
    sizes = np.bincount(parts[is_inside], minlength=1 + parts.max())
    sizes[0] = 0
    if sizes.max() < LEAST:
        raise Conflict("nothing stands before the monitor")
    found = (sizes >= LEAST_PART * sizes.max())[parts]
    others, _ = label(~found)
    sizes = np.bincount(others.ravel())
    sizes[np.unique(np.concatenate([others[0], others[-1], others[:, 0], others[:, -1]]))] = found.size
    return np.asarray(found | (sizes < LEAST_HOLE * np.count_nonzero(found))[others])


def off_sight(block: Block, matte: Gridded, sight: Doubles, pitch: float, aspect: float) -> Floats:
    """How far the light of each pixel is from where it would look beside the object, in widths of the monitor.

    Parameters
    ----------
    sight : (h, w, 2) float64
    pitch, aspect : float
        See `CutOut`.

    Returns
    -------
    (h, w) float32
        Infinite where more than a quarter of the light comes from elsewhere.
    """
    transport = transport_of(matte, block)
    reach = max(REACH * pitch, 2 / matte.columns)
    off = np.empty(len(transport.count), np.float32)
    grids = Pyramid.over(matte.columns, matte.rows).arrays
    rows = transport.count, transport.cell, transport.weight
    _measure_off(rows, grids, sight.reshape(-1, 2), reach, aspect, off)
    return off.reshape(sight.shape[:2])


@njit(nogil=True, cache=True)
def _measure_off(
    transport: tuple[NDArray[np.uint32], NDArray[np.uint32], Floats],
    grids: Grids,
    sight: Doubles,
    reach: float,
    aspect: float,
    off: Floats,
) -> None:
    """See `off_sight`: the distance from the centre of the light within reach, in nodes that are no wider than that."""
    count, cell, weight = transport
    columns, rows, starts = grids
    entry = 0
    for pixel in range(len(count)):
        total, near, right, below = 0.0, 0.0, 0.0, 0.0
        for _ in range(count[pixel].sum()):
            node, level = np.int64(cell[entry]), 0
            while node >= starts[level + 1]:
                level += 1
            row, column = divmod(node - starts[level], columns[level])
            wide = 2.0**level / columns[0]
            u = (column + 0.5) * wide - sight[pixel, 0]
            v = ((row + 0.5) * 2.0**level / rows[0] - sight[pixel, 1]) * aspect
            total += weight[entry]
            if wide <= reach and u * u + v * v <= reach * reach:
                near += weight[entry]
                right += weight[entry] * u
                below += weight[entry] * v
            entry += 1
        off[pixel] = np.inf
        if near > DIRECT * total:
            off[pixel] = np.hypot(right, below) / near
