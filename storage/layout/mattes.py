"""A matte in the store: S, rho and T in zarr arrays that any zarr reader can read.

``mattes/ID`` is a zarr group with the attributes ``format``, ``width``, ``height``, ``monitor`` (its width and
height), ``columns`` and ``rows`` (the first grid of T's cells), ``block``, ``crosstalk`` (X of
``C = S + X (rho T L)``: a row for each channel of the camera, a column for each of the monitor), the options that it
was recovered with, and ``interval``, see `workflows.recovery.interval`, if that was measured. If the object was cut
out, ``beside`` is what the frame sees beside it: ``sight``, the homography (three rows) to places on the monitor, both
from 0 to 1 across and down; and ``rho`` of the bare monitor, by channel. In it are

- ``S``, ``rho`` (y, x, channel) float32;
- ``count`` (y, x, channel) uint32: the number of cells in the row T of a pixel and channel;
- ``shared`` (y, x) bool: whether a pixel's first row T holds for all of its channels, and the others are empty;
- ``error`` (y, x) float32: expected root mean squared error of a composite at the pixel, in camera units; infinite
  where nothing could be recovered;
- ``recovered`` (y, x) bool: false where the capture's mask excludes the pixel, or it is no part of the object;
- ``T/R.C/cell`` and ``T/R.C/weight``, one-dimensional, for the block in block row R and block column C: the cells and
  weights of its rows T, concatenated in the order (y, x, channel).

Cells are numbered ``row * columns + column``, row 0 at the top, first in a grid over the monitor, then in a grid of
half as many columns and rows (rounded up), and so on. A cell of the first grid sees the mean light over it. A cell of
a further grid sees sixteen cells of the previous grid, columns 2 column - 1 to 2 column + 2 and rows likewise, with the
weights [1, 3, 3, 1] / 8 along each axis; beyond the edge, the cells at the edge count instead.

A block is a square of ``block`` pixels and one chunk of each frame-shaped array. A task that recovers a block writes
all of it and nothing else, so blocks can be written in any order, by any worker, and repeatedly.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.storage import MemoryStore

from storage.errors import Corrupt
from storage.layout.blocks import block_edge
from storage.objects.checksums import CODECS, damaged, is_checked
from storage.objects.event_loop import gather
from storage.objects.store import Objects
from storage.objects.zarr_store import unpack

FORMAT = "envmatte-matte/1"
FRAMES = ("S", "rho", "error", "recovered", "shared", "count")
"""The frame-shaped arrays."""
CHANNELS = ("S", "rho", "count")
"""The frame-shaped arrays that have channels."""
FIGURES = ("width", "height", "monitor", "columns", "rows", "block")
"""The attributes that describe a matte in lists."""


@dataclass(frozen=True)
class Block:
    """One block of a matte, h x w pixels.

    Attributes
    ----------
    S, rho : (h, w, 3) float32
    error : (h, w) float32
    recovered, shared : (h, w) bool
    count : (h, w, 3) uint32
    cell : (count.sum(),) uint32
    weight : (count.sum(),) float32
    """

    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    error: NDArray[np.float32]
    recovered: NDArray[np.bool_]
    shared: NDArray[np.bool_]
    count: NDArray[np.uint32]
    cell: NDArray[np.uint32]
    weight: NDArray[np.float32]


def empty_block(height: int, width: int) -> Block:
    """A block in which no pixel is recovered."""
    zeros, no = np.zeros((height, width, 3), np.float32), np.zeros((height, width), bool)
    count = np.zeros((height, width, 3), np.uint32)
    return Block(zeros, zeros, zeros[..., 0].copy(), no, no, count, *_no_rows())


def _no_rows() -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    return np.zeros(0, np.uint32), np.zeros(0, np.float32)


def path(matte: str) -> str:
    """Path of a matte in the store."""
    return f"mattes/{matte}"


def chunk_entry(name: str, row: int, column: int) -> str:
    """Path within a matte of the chunk of a block in a frame-shaped array."""
    return f"{name}/c/{row}/{column}" + ("/0" if name in CHANNELS else "")


def rows_folder(row: int, column: int) -> str:
    """Path within a matte of the rows T of a block."""
    return f"T/{row}.{column}"


def preview_of(matte: str) -> str:
    """Name in the store of a matte's preview, a coarse matte that is there until the matte itself is complete."""
    return f"{matte}/preview"


class Matte:
    """A matte in the store.

    Attributes
    ----------
    attributes : dict
    height, width : int
        Of the frame, in pixels.
    columns, rows : int
        The first grid of T's cells.
    block : int
        Edge of a block, in pixels.
    """

    def __init__(self, objects: Objects, matte: str) -> None:
        at = path(matte)
        try:
            group, *frames = gather(objects.group(at), *(objects.array(f"{at}/{name}") for name in FRAMES))
        except FileNotFoundError as error:
            raise Corrupt(f"matte {matte} is not in the store; recover it again") from error
        self._objects = objects
        self._path = at
        self._frames: dict[str, zarr.Array[Any]] = dict(zip(FRAMES, frames, strict=True))
        self._is_checked = is_checked(self._frames["S"].metadata.to_dict())
        self.attributes: dict[str, Any] = dict(group.attrs)
        self.height, self.width, self.columns, self.rows, self.block = (
            int(self.attributes[name]) for name in ("height", "width", "columns", "rows", "block")
        )

    @property
    def figures(self) -> dict[str, Any]:
        """What describes a matte in lists: some attributes, and whether it knows what is beside the object."""
        described = {name: self.attributes[name] for name in FIGURES}
        return described | {"cut_out": "beside" in self.attributes}

    @property
    def block_rows(self) -> int:
        """Number of blocks from top to bottom."""
        return -(-self.height // self.block)

    @property
    def block_columns(self) -> int:
        """Number of blocks from left to right."""
        return -(-self.width // self.block)

    def span(self, row: int, column: int) -> tuple[slice, slice]:
        """The rows and columns of the frame that a block covers."""
        y, x = row * self.block, column * self.block
        return slice(y, min(y + self.block, self.height)), slice(x, min(x + self.block, self.width))

    def write(self, row: int, column: int, block: Block) -> None:
        """Write a block, replacing an earlier one."""
        span, rows = self.span(row, column), f"{self._path}/{rows_folder(row, column)}"

        async def write(name: str) -> None:
            await self._frames[name].async_array.setitem(span, getattr(block, name))

        gather(
            self._objects.put_group(rows),
            self._objects.put_array(f"{rows}/cell", block.cell),
            self._objects.put_array(f"{rows}/weight", block.weight),
            *(write(name) for name in FRAMES if name != "count"),
        )
        # ``count`` is written last: a block with counts is complete.
        gather(write("count"))

    def counts(self, row: int, column: int) -> NDArray[np.uint32]:
        """The counts of a block, (h, w, 3): what reading all of it takes.

        Raises
        ------
        Corrupt
            If they are missing or damaged.
        """
        return np.asarray(self._frames["count"][self.span(row, column)])

    def read(self, row: int, column: int) -> Block:
        """Read a block.

        Raises
        ------
        Corrupt
            If some of it is missing or damaged.
        """
        count, recovered = self._chunks(row, column, "count", "recovered")
        entries = int(count.sum())
        if entries == 0 and not recovered.any():  # most of a frame: the mask leaves it out
            return empty_block(*count.shape[:2])
        S, rho, error, shared = self._chunks(row, column, "S", "rho", "error", "shared")
        cell, weight = self._rows(row, column, entries) if entries else _no_rows()
        return Block(S, rho, error, recovered, shared, count, cell, weight)

    def chunk(self, name: str, row: int, column: int) -> NDArray[Any]:
        """The values of a block in one of the frame-shaped arrays.

        Raises
        ------
        Corrupt
            If they are missing or damaged.
        """
        return self._chunks(row, column, name)[0]

    def _chunks(self, row: int, column: int, *names: str) -> list[NDArray[Any]]:
        """The values of a block in frame-shaped arrays."""
        height, width = (span.stop - span.start for span in self.span(row, column))
        arrays = [self._frames[name] for name in names]
        entries = [chunk_entry(name, row, column) for name in names]
        found = self._unpacked(entries, [array.dtype for array in arrays], [array.chunks for array in arrays])
        # Chunks at the edges of the frame are padded to full size.
        return [np.ascontiguousarray(values[:height, :width]) for values in found]

    def _rows(self, row: int, column: int, entries: int) -> list[NDArray[Any]]:
        """Cells and weights of the rows T of a block that has some."""
        rows, types = rows_folder(row, column), [np.dtype(np.uint32), np.dtype(np.float32)]
        try:
            return self._unpacked([f"{rows}/cell/c/0", f"{rows}/weight/c/0"], types, [(entries,)] * 2)
        except ValueError as error:
            raise self._corrupt(row, column) from error

    def _unpacked(
        self, entries: Sequence[str], types: Sequence[np.dtype[Any]], shapes: Sequence[tuple[int, ...]]
    ) -> list[NDArray[Any]]:
        """Chunks of the matte. `Corrupt` if one is damaged, ValueError if it has fewer values than its shape."""
        paths = [f"{self._path}/{entry}" for entry in entries]
        found = []
        for path, packed, kind, shape in zip(paths, self._objects.get(paths), types, shapes, strict=True):
            try:
                values = unpack(packed, math.prod(shape) * kind.itemsize, self._is_checked)
            except ValueError as error:
                raise damaged(path) from error
            found.append(np.frombuffer(values, kind).reshape(shape))
        return found

    def layer(self, name: str, rows: slice = slice(None)) -> NDArray[Any]:
        """A frame-shaped array, or some rows of it.

        Raises
        ------
        Corrupt
            If some of it is missing or damaged.
        """
        return np.asarray(self._frames[name][rows])

    def missing(self) -> set[tuple[int, int]]:
        """Rows and columns of incomplete blocks; lists the store and reads nothing."""
        stored = self._objects.paths_below(self._path)

        def is_complete(row: int, column: int) -> bool:
            chunks = (f"{self._path}/{chunk_entry(name, row, column)}" for name in FRAMES)
            rows = [f"{self._path}/{rows_folder(row, column)}/{name}" for name in ("cell", "weight")]
            # A block whose rows T are all empty has neither chunk.
            return (
                all(chunk in stored for chunk in chunks)
                and all(f"{array}/zarr.json" in stored for array in rows)
                and len({f"{array}/c/0" in stored for array in rows}) == 1
            )

        blocks = product(range(self.block_rows), range(self.block_columns))
        return {block for block in blocks if not is_complete(*block)}

    def _corrupt(self, row: int, column: int) -> Corrupt:
        return Corrupt(f"block {row}.{column} of the matte is missing or damaged; recover the matte again")


def create(
    objects: Objects, matte: str, *, height: int, width: int, columns: int, rows: int, **attributes: Any
) -> Matte:
    """Create an empty matte; a repeated call writes the same and leaves blocks written since as they are.

    Parameters
    ----------
    height, width : int
        Of the frame, in pixels.
    columns, rows : int
        The first grid of T's cells.
    **attributes
        What it is recovered from and with, as JSON; without times and ids, so that the same input gives the same bytes.
    """
    edge = block_edge(height, width)
    layout = {
        "format": FORMAT,
        "height": height,
        "width": width,
        "columns": columns,
        "rows": rows,
        "block": edge,
    }
    made = MemoryStore()
    group = zarr.create_group(made, attributes=layout | attributes)
    frame, chunk = (height, width), (min(edge, height), min(edge, width))
    dims = ("y", "x", "channel")
    for name, kind in (("S", "float32"), ("rho", "float32"), ("count", "uint32")):
        group.create_array(
            name, shape=(*frame, 3), chunks=(*chunk, 3), dtype=kind, compressors=CODECS, dimension_names=dims
        )
    for name, kind in (("error", "float32"), ("recovered", "bool"), ("shared", "bool")):
        group.create_array(
            name, shape=frame, chunks=chunk, dtype=kind, compressors=CODECS, dimension_names=dims[:2]
        )
    group.create_group("T")
    objects.put_tree(path(matte), made)
    return Matte(objects, matte)
