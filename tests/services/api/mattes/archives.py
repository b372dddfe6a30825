"""Archives of synthetic mattes."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from storage.layout import mattes
from storage.layout.matte_archive import Archive
from storage.layout.mattes import empty_block
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
            black = empty_block(*(span.stop - span.start for span in matte.span(row, column)))
            S = rng.random(black.S.shape, np.float32)
            matte.write(row, column, replace(black, S=S, recovered=~black.recovered))
    return b"".join(Archive(objects, "plain"))
