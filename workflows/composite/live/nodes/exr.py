"""A matte's lookups, S, rho and alpha as one EXR, from which nodes draw the glass.

It is the model of `workflows.composite.live`, for every pixel of the frame and without its rounding to bytes:

=========================  =====================================================================================
``R``, ``G``, ``B``, ``A``  The glass in front of a white monitor, so that every viewer shows something; and alpha
``S``, ``rho``              R, G and B of each
``lookup0`` ...             R: u; G: v; B: the level, of each lookup, the heaviest first. 32 bits
``weight0`` ...             R, G and B: what each channel takes of that lookup
=========================  =====================================================================================

u and v go from 0 to 1 over the monitor, from its bottom left. The other channels have 16 bits. A pixel with fewer
lookups has zeros in the rest. The header has ``chromaticities``, those of Rec. 709, in which the light is linear; the
matrix ``crosstalk``; and the pairs ``monitor``, its pixels, and ``cells``, columns and rows of the first level.

The backdrop has levels. The first is its mean over each of ``cells``; each further one has half as many columns and
rows, rounded up, and sees the one before with the weights [1, 3, 3, 1] / 8 along each axis, from its top left, with the
edge repeated. A lookup at (u, v) is bilinear in the two levels next to its own, and linear between those. Then::

    C = S + crosstalk (rho * sum over k of weight_k * light(lookup_k))
"""

from collections.abc import Iterator
from typing import IO

import numpy as np
from numpy.typing import NDArray

from storage.layout.mattes import Block, Matte
from workflows.composite.live.lookups import block_lookups
from workflows.images.float_formats import REC_709
from workflows.images.writers.exr import Types, write_exr
from workflows.threads import CORES, in_parts

LOOKUPS = 16
"""Lookups of a pixel, unless another number is asked for, and at most: a node is for the best picture."""
CLUSTERS = 64
"""Of a pixel, see `fit_lookups`: more than the web app's, for the same reason."""
_COMMENTS = (
    "C = S + crosstalk (rho * sum_k weight_k * light(lookup_k)). lookup: u, v from the bottom left, level of the "
    "backdrop's pyramid, whose first has `cells`. Linear light."
)


def write_lookups(matte: Matte, file: IO[bytes], lookups: int) -> None:
    """Write the EXR of this module.

    Parameters
    ----------
    matte : Matte
    file : IO[bytes]
        Empty, and seekable.
    lookups : int
        Of a pixel; further nodes of T are merged into these.

    Raises
    ------
    Corrupt
        If a block of the matte is missing.
    """
    types = _types(lookups)
    crosstalk = np.array(matte.attributes["crosstalk"], np.float32)

    def bands() -> Iterator[dict[str, NDArray[np.float32]]]:
        for row in range(matte.block_rows):
            rows = matte.span(row, 0)[0]
            planes = {
                name: np.zeros((rows.stop - rows.start, matte.width), kind) for name, kind in types.items()
            }

            def draw(column: int, row: int = row, planes: dict[str, NDArray[np.floating]] = planes) -> None:
                block = matte.read(row, column)
                at = slice(None), matte.span(row, column)[1]
                for name, values in _images(matte, block, lookups, crosstalk).items():
                    for c, channel in enumerate("RGB"):
                        planes[f"{name}.{channel}" if name else channel][at] = values[..., c]
                planes["A"][at] = block.recovered

            in_parts(draw, range(matte.block_columns), CORES)
            yield planes

    header = {
        "chromaticities": REC_709,
        "crosstalk": crosstalk,
        "monitor": tuple(matte.attributes["monitor"]),
        "cells": (matte.columns, matte.rows),
        "comments": _COMMENTS,
    }
    write_exr(file, matte.width, matte.height, types, bands(), header)


def bytes_of_lookups(width: int, height: int, lookups: int) -> int:
    """Bytes of a frame's values in the EXR, before they are compressed."""
    return width * height * (10 * 2 + lookups * (3 * 4 + 3 * 2))


def _types(lookups: int) -> Types:
    types: dict[str, type[np.float16] | type[np.float32]] = dict.fromkeys("RGBA", np.float16)
    for name in ("S", "rho", *(f"weight{k}" for k in range(lookups))):
        types |= dict.fromkeys((f"{name}.{c}" for c in "RGB"), np.float16)
    for k in range(lookups):
        types |= dict.fromkeys((f"lookup{k}.{c}" for c in "RGB"), np.float32)
    return types


def _images(
    matte: Matte, block: Block, lookups: int, crosstalk: NDArray[np.float32]
) -> dict[str, NDArray[np.float32]]:
    """The images (h, w, 3) of a block by name; that of the glass in front of white has none."""
    found = block_lookups(matte, block, lookups, clusters=CLUSTERS)
    used = found[..., 3:].any(axis=-1)
    found[..., 0] /= matte.columns
    found[..., 1] = np.where(used, 1 - found[..., 1] / matte.rows, 0)
    images = {
        "": block.S + (block.rho * found[..., 3:].sum(axis=-2)) @ crosstalk.T,
        "S": block.S,
        "rho": block.rho,
    }
    for k in range(lookups):
        images |= {f"lookup{k}": found[..., k, :3], f"weight{k}": found[..., k, 3:]}
    return images
