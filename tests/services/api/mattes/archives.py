"""Archives of synthetic mattes."""

from pathlib import Path

import numpy as np

from storage.layout import mattes
from storage.layout.matte_archive import Archive
from storage.layout.mattes import Block
from storage.objects.store import Objects


def archive(folder: Path, width: int, height: int) -> bytes:
    """The archive of an opaque matte of noise, which no picture format can compress."""
    objects = Objects(folder.as_uri())
    matte = mattes.create(
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
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            shape = tuple(span.stop - span.start for span in matte.span(row, column))
            S = rng.random((*shape, 3), np.float32)
            flags, zero = np.ones(shape, bool), np.zeros(shape, np.float32)
            empty = np.zeros(0, np.uint32), np.zeros(0, np.float32)
            matte.write(
                row, column, Block(S, 0 * S, zero, flags, ~flags, np.zeros(S.shape, np.uint32), *empty)
            )
    return b"".join(Archive(objects, "plain"))
