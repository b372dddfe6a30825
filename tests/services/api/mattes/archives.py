"""Mattes that nothing was filmed for, as archives."""

from pathlib import Path

import numpy as np

from storage.layout import mattes
from storage.layout.matte_archive import Archive
from storage.layout.mattes import Block
from storage.objects.store import Objects


def archive(folder: Path, width: int, height: int) -> bytes:
    """The archive of a matte of noise, which no picture file packs, and through which no light comes."""
    objects = Objects(folder.as_uri())
    made = mattes.create(
        objects,
        "plain",
        width=width,
        height=height,
        columns=8,
        rows=6,
        monitor=[64, 48],
        crosstalk=np.eye(3).tolist(),
        options={"method": "lobes"},
    )
    rng = np.random.default_rng(0)
    for row in range(made.block_rows):
        for column in range(made.block_columns):
            shape = tuple(span.stop - span.start for span in made.span(row, column))
            S = rng.random((*shape, 3), np.float32)
            flags, zero = np.ones(shape, bool), np.zeros(shape, np.float32)
            empty = np.zeros(0, np.uint32), np.zeros(0, np.float32)
            made.write(
                row, column, Block(S, 0 * S, zero, flags, ~flags, np.zeros(S.shape, np.uint32), *empty)
            )
    return b"".join(Archive(objects, "plain"))
