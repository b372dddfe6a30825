"""Mattes that are made to cost as much as they can: archives of small ones, and stored ones with a large frame."""

import os
import shutil
from itertools import product
from pathlib import Path

import numpy as np

from storage.layout import mattes
from storage.layout.matte_archive import Archive
from storage.layout.mattes import FRAMES, Block, Matte
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


def large_matte(store: Path, matte: str, edge: int) -> Matte:
    """Write a matte of edge x edge pixels of noise, each of which sees a single cell, into a store that is a folder.

    All of its blocks are the same, and links to the first: ``edge`` is a multiple of a block's.
    """
    objects = Objects(store.as_uri())
    made = mattes.create(
        objects,
        matte,
        width=edge,
        height=edge,
        columns=64,
        rows=64,
        monitor=[64, 64],
        crosstalk=np.eye(3).tolist(),
        options={"method": "lobes"},
    )
    frame = made.block, made.block
    pixels = made.block**2
    S, rho = np.random.default_rng(0).random((2, *frame, 3), np.float32)
    whole = np.ones(frame, bool)
    count = np.zeros((*frame, 3), np.uint32)
    count[..., 0] = 1
    cell, weight = np.arange(pixels, dtype=np.uint32) % (64 * 64), np.ones(pixels, np.float32)
    made.write(0, 0, Block(S, rho, 0 * S[..., 0], whole, whole, count, cell, weight))
    folder = store / mattes.path(matte)
    for row, column in product(range(made.block_rows), range(made.block_columns)):
        if (row, column) == (0, 0):
            continue
        shutil.copytree(folder / "T/0.0", folder / f"T/{row}.{column}", copy_function=os.link)
        for name in FRAMES:
            first, copy = folder / name / "c/0/0", folder / name / f"c/{row}/{column}"
            if first.is_dir():
                shutil.copytree(first, copy, copy_function=os.link)
            else:
                copy.parent.mkdir(exist_ok=True)
                os.link(first, copy)
    return made
