"""Pixels of some squares spread over a capture, as each of its frames saw them: what trials are made with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from storage.layout.captures import Stack
from workflows.images.integer_formats import Codes
from workflows.images.resample import LANCZOS_LOBES
from workflows.ingest.camera.lit import find_lit
from workflows.ingest.light.local_gain import local_gain
from workflows.ingest.light.measured_light import even_out, unclipped_light
from workflows.ingest.light.stack_attributes import clipped_from, look_up_of, odd_frames, program_of

EDGE = 8
"""Side in pixels of the squares that are examined."""
BLOCK = 4
"""Side in pixels of the blocks of neighbours that are taken of larger samples' squares."""
SQUARES = 40
"""Squares, at most, spread over what is recovered."""
BYTES = 96 << 20
"""Bytes of their frames, at most."""
MIN_SQUARES = 8
"""Squares that are needed: the spread of their results gives the standard error."""
PIXELS = 640
"""Pixels of the squares that are recovered, at most."""
VALUES = 1 << 20
"""Pixels times frames that are recovered, at most."""
MIN_PIXELS = 100
"""Pixels with contrast that are needed."""
FURTHEST = 3
"""Pixels that a frame may be shifted by."""
SLOPE = 2
"""Pixels on each side that a slope is taken from."""
MARGIN = SLOPE + LANCZOS_LOBES + FURTHEST
"""Pixels that are read around those that are examined."""

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class PixelSample(NamedTuple):
    """Pixels of some squares in all frames.

    Attributes
    ----------
    codes : (frames, squares, h, w, channels) uint8 or uint16
        With `MARGIN` on each side.
    chosen : three (n,) intp
        Square, row and column of each pixel, counted without the margins.
    every : three (k,) intp
        All pixels of the squares that are to be recovered and see the monitor, likewise.
    wanted : int
        Pixels of the whole frame that are to be recovered and see the monitor.
    corners : (squares, 2) intp
        Row and column in the frame of the first pixel of each square.
    """

    codes: Codes
    chosen: tuple[NDArray[np.intp], ...]
    every: tuple[NDArray[np.intp], ...]
    wanted: int
    corners: NDArray[np.intp]

    @property
    def places(self) -> NDArray[np.intp]:
        """Row and column of each pixel in the frame, (2, n)."""
        return self.corners[self.chosen[0]].T + self.chosen[1:]

    def rings(self, widest: int) -> list[Floats]:
        """The mean codes, as a share of full scale, of the square rings around each pixel, (frames, n) each: of its 8
        neighbours, of the 16 pixels around these, and so on.
        """
        square, y, x = self.chosen
        grey = self.codes.mean(axis=4, dtype=np.float32) / np.float32(np.iinfo(self.codes.dtype).max)
        edges = range(1, 2 * widest + 2, 2)
        sums = [
            uniform_filter(grey, (0, 0, edge, edge))[:, square, y + MARGIN, x + MARGIN] * edge**2
            for edge in edges
        ]
        return [(sums[n] - sums[n - 1]) / (8 * n) for n in range(1, len(sums))]

    def blocks(self) -> "PixelSample":
        """About as many pixels as were chosen, but neighbours: all of the squares, or a block of each."""
        square, y, x = self.every
        chosen, most = np.ones(len(square), bool), len(self.chosen[0])
        if len(square) > most:
            blocks = (EDGE // BLOCK) ** 2
            number = blocks * square + EDGE // BLOCK * (y // BLOCK) + x // BLOCK
            pixels = np.bincount(number, minlength=blocks * len(self.corners)).reshape(-1, blocks)
            largest = blocks * np.arange(len(pixels)) + pixels.argmax(axis=1)
            step = max(round(int(pixels.max(axis=1).sum()) / most), 1)
            chosen = np.isin(number, largest[::step])
        return self._replace(chosen=tuple(axis[chosen] for axis in self.every))

    def thinned(self, most: int) -> "PixelSample":
        """The same squares with at most so many of the chosen pixels, spread over all of them."""
        step = -(-len(self.chosen[0]) // most)
        return self._replace(chosen=tuple(axis[::step] for axis in self.chosen))

    def some_squares(self) -> "PixelSample":
        """All pixels of some of the squares, about as many as were chosen."""
        step = -(-len(self.every[0]) // len(self.chosen[0]))
        whole = self.every[0] % step == 0
        return self._replace(chosen=tuple(axis[whole] for axis in self.every))


class Seen(NamedTuple):
    """The sample in frames that were shifted back; all arrays are (frames, n, channels)."""

    values: Floats
    whole: NDArray[np.bool_]
    slopes: tuple[Floats, Floats]


def take_sample(stack: Stack, masked: bool = True) -> PixelSample | None:
    """Choose squares spread over the pixels to recover that see the monitor, and pixels in them; None if there are too
    few. Unless ``masked``, all that see the monitor are taken for those to recover.
    """
    wanted = find_lit(stack, program_of(stack.attributes))
    if masked:
        wanted &= stack.mask()
    down, across = (np.arange(MARGIN, size - MARGIN - EDGE + 1, EDGE) for size in wanted.shape)
    corners = [(y, x) for y in down.tolist() for x in across.tolist()]
    counts = np.array([np.count_nonzero(wanted[y : y + EDGE, x : x + EDGE]) for y, x in corners], int)
    useful = np.flatnonzero(counts >= EDGE**2 // 4)
    size = stack.frames * (EDGE + 2 * MARGIN) ** 2 * stack.channels * stack.dtype.itemsize
    most = min(len(useful), SQUARES, BYTES // size)
    if most < MIN_SQUARES:
        return None
    corners = [corners[useful[at]] for at in np.linspace(0, len(useful) - 1, most).astype(int)]
    wide = EDGE + MARGIN
    squares = [stack.read(slice(y - MARGIN, y + wide), slice(x - MARGIN, x + wide)) for y, x in corners]
    inside = np.stack([wanted[y : y + EDGE, x : x + EDGE] for y, x in corners])
    every = np.nonzero(inside)
    limit = max(min(PIXELS, VALUES // stack.frames), MIN_PIXELS)
    count = int(np.count_nonzero(wanted))
    whole = PixelSample(np.stack(squares, axis=1), every, every, count, np.array(corners, np.intp))
    return whole.thinned(limit)


def see_sample(stack: Stack, sample: PixelSample, shifts: Doubles) -> Seen:
    """The sample in frames that are shifted back."""
    look_up = look_up_of(stack)
    square, y, x = sample.chosen
    y, x = y + SLOPE, x + SLOPE
    shape = (stack.frames, len(square), stack.channels)
    values, across, down = np.empty((3, *shape), np.float32)
    whole, odd = np.empty(shape, bool), set(odd_frames(stack.attributes))
    for n, (codes, shift) in enumerate(zip(sample.codes, shifts.tolist(), strict=True)):
        picture, unclipped = unclipped_light(codes, shift, MARGIN - SLOPE, look_up, clipped_from(stack))
        picture = even_out(picture, n, stack.attributes)
        values[n], whole[n] = picture[square, y, x], unclipped[square, y, x] & (n not in odd)
        # The slope of the polynomial through five values.
        for slope, (dy, dx) in ((across, (0, 1)), (down, (1, 0))):
            near = picture[square, y + dy, x + dx] - picture[square, y - dy, x - dx]
            far = picture[square, y + 2 * dy, x + 2 * dx] - picture[square, y - 2 * dy, x - 2 * dx]
            slope[n] = (8 * near - far) / 12
    gain = local_gain(stack)
    if gain is not None:
        local = gain.at(*sample.places)[..., np.newaxis]
        for part in (values, across, down):
            part /= local
    return Seen(values, whole, (across, down))
