"""The preview of a matte: a matte of every k-th row and column of its frame, there before the rest is recovered."""

import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout import mattes
from storage.layout.captures import Stack
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows.mattes import tiles
from workflows.mattes.options import parse_options
from workflows.threads import CORES, in_parts

PIXELS = 1 << 14
"""Pixels that are recovered at most: they take some seconds of one core."""
LEAST_SPACING = 4
"""A closer lattice would take too large a share of the whole recovery, which then is soon done."""


def spacing_of(stack: Stack, least: int = LEAST_SPACING) -> int | None:
    """Of how many rows and columns of a capture a preview has one; None if it has no preview."""
    spacing = math.ceil(math.sqrt(int(stack.mask().sum()) / PIXELS))
    return spacing if spacing >= least else None


def recover_preview(objects: Objects, capture: str, matte: Matte, name: str, spacing: int) -> None:
    """Recover the preview of a matte, whatever its method by lobes, and store it.

    It uses all cores: nothing else of the job can be done before, and people wait for it. Frames that drift are shifted
    by whole pixels only, for which few values are read.

    Parameters
    ----------
    capture : str
    matte : Matte
        Whose frame and grid the preview has.
    name : str
        Of the matte in the store.
    spacing : int
        Rows and columns from one to the next; the first is at half of it.

    Raises
    ------
    Corrupt
        If the store lacks the capture.
    """
    stack, options = Stack(objects, capture), parse_options({"method": "lobes", "quality": "fast"})
    height, width = (len(range(spacing // 2, size, spacing)) for size in (stack.height, stack.width))
    columns, rows = tiles.grid_of(objects, capture, options)
    attributes: dict[str, Any] = {
        "monitor": matte.attributes["monitor"],
        "crosstalk": matte.attributes["crosstalk"],
        "options": options.model_dump(mode="json", exclude={"tile"}),
    }
    preview = mattes.create(
        objects,
        mattes.preview_of(name),
        height=height,
        width=width,
        columns=columns,
        rows=rows,
        **attributes,
    )
    tiles.patterns_of(objects, capture)  # once, before several threads ask for it
    blocks = list(product(range(preview.block_rows), range(preview.block_columns)))

    def recover(number: int) -> None:
        y, x = (
            slice(at.start * spacing + spacing // 2, at.stop * spacing, spacing)
            for at in preview.span(*blocks[number])
        )
        preview.write(*blocks[number], tiles.recover_block(objects, stack, capture, (y, x), options))

    in_parts(recover, range(len(blocks)), CORES)


def show_only(preview: Matte, shown: NDArray[np.bool_]) -> None:
    """Show some pixels of a preview alone, (y, x) bool. The others' rows of T stay."""
    for row, column in product(range(preview.block_rows), range(preview.block_columns)):
        block = preview.read(row, column)
        preview.write(row, column, replace(block, recovered=shown[preview.span(row, column)]))
