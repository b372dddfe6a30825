"""The light of a program's patterns on a pyramid over the monitor."""

from collections.abc import Sequence
from itertools import compress, islice

import numpy as np
from numpy.typing import NDArray

from workflows.grids import area_mean
from workflows.program import Program
from workflows.recovery.pyramid import Pyramid, halve_codes
from workflows.recovery.sensing import Patterns
from workflows.tone import Curve, to_light

PATTERNS_BYTES = 256 << 20
"""What a worker may hold of a program; with more patterns or pixels, the pyramid starts at cells of several pixels."""

# Patterns written at a time: a node's are neighbours in memory.
_BATCH = 16


def pyramid_of(program: Program, channels: int) -> Pyramid:
    """The pyramid that the patterns of a program are laid out on: over the monitor's pixels, or over cells of
    2 x 2, 4 x 4, … of them where all of it would take more than `PATTERNS_BYTES`."""
    columns, rows = program.monitor.width, program.monitor.height
    while (pyramid := Pyramid.over(columns, rows)).nodes * channels * program.measured.size > PATTERNS_BYTES:
        columns, rows = -(-columns // 2), -(-rows // 2)
    return pyramid


def lay_out(program: Program, curve: Curve, images: Sequence[NDArray[np.float32]] = ()) -> Patterns:
    """Lay the patterns of a program, constants left out, on its pyramid.

    Parameters
    ----------
    program : Program
    curve : Curve
        From the value sent to the monitor to the light emitted.
    images : sequence of (rows, columns, 1 or 3) float32
        The images of the `Images` parts, in order.

    Returns
    -------
    Patterns
    """
    channels = program.channels(images)
    pyramid = pyramid_of(program, channels)
    columns, rows = pyramid.grids[0]
    m = program.measured.size
    code = np.empty((pyramid.nodes, channels * m), np.uint8)
    shown = program.pictures(0, program.count, images)
    measured = compress(shown, np.isin(np.arange(program.count), program.measured))
    for first in range(0, m, _BATCH):
        batch = np.empty((rows, columns, channels, min(_BATCH, m - first)), np.uint8)
        for i, picture in enumerate(islice(measured, batch.shape[3])):
            light = area_mean(to_light(picture, curve), columns, rows)
            batch[..., i] = np.rint(light * np.float32(255))
        for c in range(channels):
            at = c * m + first
            code[: columns * rows, at : at + batch.shape[3]] = batch[:, :, c].reshape(columns * rows, -1)
    sums = np.empty(channels * m, np.uint16)
    for level in range(len(pyramid.grids) - 1):
        fine, coarse = (code[slice(*pyramid.starts[at : at + 2])] for at in (level, level + 1))
        halve_codes(fine, *pyramid.grids[level], coarse, sums)
    return Patterns(pyramid, channels, code)
