"""The light of a program's patterns on a pyramid of grids over the monitor."""

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from workflows.images.integer_formats import Codes, to_integers
from workflows.images.resample import area_mean
from workflows.images.tone_curves import Curve, to_light
from workflows.programs.interpolation import interpolated_light
from workflows.programs.parts import Constant, Halftone, Images
from workflows.programs.program import Program
from workflows.recovery.pyramid import Pyramid, halve_codes
from workflows.recovery.sensing import Patterns

CODE = np.dtype(np.uint8)
PATTERNS_BYTES = 256 << 20
"""Bytes that a worker may hold of a program. Beyond that, the pyramid starts at cells of several pixels."""
MOST_SCALED = 1 << 23
"""Pixels of a monitor up to which the light of scaled patterns is worked out, one pattern in full at a time. On larger
monitors blocks have more pixels, and their edges lose little light."""

# Patterns written at a time, because the patterns of a node are neighbours in memory.
_BATCH = 24


def pyramid_of(program: Program, channels: int) -> Pyramid:
    """The pyramid for the patterns of a program.

    It starts at the monitor's pixels, or at cells of 2 x 2, 4 x 4, ... of them if it took more than `PATTERNS_BYTES`.
    """
    columns, rows = program.monitor.width, program.monitor.height
    while (pyramid := Pyramid.over(columns, rows)).nodes * channels * program.measured.size > PATTERNS_BYTES:
        columns, rows = -(-columns // 2), -(-rows // 2)
    return pyramid


def lay_out(
    program: Program, curve: Curve, images: Sequence[NDArray[np.float32]] = (), *, scaled: bool = False
) -> Patterns:
    """Lay the patterns of a program, without the constant ones, out on its pyramid.

    Parameters
    ----------
    program : Program
    curve : Curve
        From value sent to the monitor to light emitted.
    images : sequence of (rows, columns, 1 or 3) float32
        The images of the `Images` parts, in order.
    scaled : bool
        Whether the monitor shows the patterns at another size, see `interpolated_light`. Images are taken as they are,
        and so are all patterns of a monitor of more than `MOST_SCALED` pixels.

    Returns
    -------
    Patterns
    """
    channels = program.channels(images)
    pyramid = pyramid_of(program, channels)
    columns, rows = pyramid.grids[0]
    m = program.measured.size
    code = np.empty((pyramid.nodes, channels * m), np.uint8)
    measured = _codes(program, curve, images, columns, rows, scaled=scaled)
    planes = np.empty((channels, min(_BATCH, m), rows, columns), np.uint8)
    for first in range(0, m, _BATCH):
        batch = planes[:, : m - first]
        for i, picture in enumerate(islice(measured, batch.shape[1])):
            batch[:, i] = np.moveaxis(picture, 2, 0)
        for c in range(channels):
            at = c * m + first
            code[: columns * rows, at : at + batch.shape[1]] = batch[c].reshape(-1, columns * rows).T
    sums = np.empty(channels * m, np.uint16)
    for level in range(len(pyramid.grids) - 1):
        fine, coarse = (code[slice(*pyramid.starts[at : at + 2])] for at in (level, level + 1))
        halve_codes(fine, *pyramid.grids[level], coarse, sums)
    return Patterns(pyramid, channels, code)


def _codes(
    program: Program,
    curve: Curve,
    images: Sequence[NDArray[np.float32]],
    columns: int,
    rows: int,
    *,
    scaled: bool,
) -> Iterator[Codes]:
    """The light of the pictures that tell T on a grid, (rows, columns, 1 or 3) uint8 each."""
    pixels = program.monitor.width * program.monitor.height
    for start, part in zip(program.starts, program.parts, strict=False):
        if isinstance(part, Constant | Halftone):
            continue
        numbers = start, start + part.count
        # The light of a cell is the mean of its pixels: the curve is applied before, rounding after.
        if scaled and pixels <= MOST_SCALED and not isinstance(part, Images):
            for picture in program.mapped(lambda values: values > 0, *numbers, images):
                lights = (interpolated_light(plane, curve) for plane in np.moveaxis(picture, 2, 0))
                cells = [area_mean(light[..., np.newaxis], columns, rows) for light in lights]
                yield to_integers(np.concatenate(cells, axis=2), CODE)
        elif pixels == columns * rows:
            yield from program.mapped(
                lambda values: to_integers(to_light(values, curve), CODE), *numbers, images
            )
        else:
            means = program.means(lambda values: to_light(values, curve), columns, rows, *numbers, images)
            yield from (to_integers(light, CODE) for light in means)
