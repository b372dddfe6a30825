"""Archives of small mattes that are made to cost as much as they can."""

from pathlib import Path

import numpy as np

from storage.layout import mattes
from storage.layout.matte_archive import Archive
from storage.layout.mattes import Block
from storage.objects.store import Objects


def hostile_archive(
    folder: Path, *, cells: int, columns: int, rows: int, edge: int = 1, apart: bool = False
) -> bytes:
    """The archive of a matte of edge x edge pixels, each of which sees a number of cells.

    Parameters
    ----------
    folder : Path
        A new folder, for working.
    columns, rows : int
        Of the grid of cells, over which those of a pixel are spread.
    apart : bool
        Whether each colour sees cells of its own, between those of the others, rather than all the same.
    """
    objects = Objects(folder.as_uri())
    side = int(np.ceil(np.sqrt(cells)))
    row, column = np.divmod(np.arange(cells), side)
    spread = row * (rows // side) * columns + column * (columns // side)
    channels = [spread[c::3] for c in range(3)] if apart else [spread]
    matte = mattes.create(
        objects,
        "hostile",
        width=edge,
        height=edge,
        columns=columns,
        rows=rows,
        monitor=[columns, rows],
        crosstalk=np.eye(3).tolist(),
        options={"method": "lobes"},
    )
    pixels, whole = edge * edge, np.ones((edge, edge), bool)
    count = np.zeros((edge, edge, 3), np.uint32)
    count[..., : len(channels)] = [len(one) for one in channels]
    cell = np.tile(np.concatenate(channels).astype(np.uint32), pixels)
    weight = np.concatenate([np.full(len(one), 1 / len(one), np.float32) for one in channels])
    light = np.ones((edge, edge, 3), np.float32)
    shared = np.full((edge, edge), not apart)
    matte.write(
        0, 0, Block(0 * light, light, 0 * light[..., 0], whole, shared, count, cell, np.tile(weight, pixels))
    )
    return b"".join(Archive(objects, "hostile"))
