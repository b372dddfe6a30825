"""A capture in the store: the stack of its frames, and what was measured from them.

``captures/ID`` is a zarr group with the arrays ``frames`` (frame, y, x, channel), ``thumbnails`` (frame, row, column),
the mean values of square blocks of each frame, optionally ``mask`` (y, x), and ``images/N`` (row, column, channel) for
the patterns that are images. ``strips`` (frame, row, column, channel) of a film with a border are some pixels from all
over the frames once more. A capture from a video also has ``shares`` (share, column): which frames of the video make
up each frame of the stack. The attributes of the group hold the manifest, those of its subgroup ``measured`` the
measurements. The uploaded archive stays where `storage.layout.uploads` has it until its frames are in the stack.
"""

from collections.abc import Coroutine, Sequence
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import TransposeCodec, ZstdCodec
from zarr.storage import MemoryStore

from storage.errors import Corrupt
from storage.layout.blocks import block_edge
from storage.objects.checksums import CODECS
from storage.objects.event_loop import gather
from storage.objects.store import Objects
from storage.objects.zarr_store import EVERY_CHUNK

MEASURED = "measured"
FRAME_CODECS = (ZstdCodec(level=1, checksum=False), *CODECS[1:])
"""Codecs of the frames' chunks. Level 3 takes twice as long; by it, means of a film's frames get larger, stills smaller
by 5 %."""
GRID = ("shape", "chunk_grid", "codecs")
"""The metadata of an array that its chunks depend on."""
FRAMES_LAST = TransposeCodec(order=(1, 2, 3, 0))
"""How the values of a film's frames lie in a chunk: those of a pixel side by side. They are packed and unpacked in 0.7
of the time, and get smaller by 12 %. Stills, which are noisier, would not."""
CHUNK = 1 << 20
"""Approximate bytes of a chunk of the stack: small enough that a tile reads little more than its own pixels."""
THUMBNAIL = 80
"""Blocks along the longer side of a frame, at most, whose means are stored."""


class Strips(NamedTuple):
    """Pixels of a frame that are stored once more: those of some rows and columns.

    Attributes
    ----------
    rows, columns : (k,) intp
    wide : int
        How many of the columns are read at a time.
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    wide: int


def path(capture: str) -> str:
    """Path of a capture in the store."""
    return f"captures/{capture}"


def create_stack(
    objects: Objects,
    capture: str,
    shape: tuple[int, int, int, int],
    dtype: np.dtype[np.generic],
    *,
    memory: int,
    attributes: dict[str, Any],
    mask: NDArray[np.bool_] | None,
    images: Sequence[NDArray[np.float32]],
    shares: NDArray[np.int64] | None = None,
    strips: Strips | None = None,
) -> int:
    """Create the empty stack of a capture; a repeated call writes the same and leaves frames written since as they are.

    If its chunks are others than before, as with another memory, or packed otherwise, as by an earlier version, the
    frames written before are deleted.

    Parameters
    ----------
    shape : (frames, height, width, channels)
    memory : int
        Bytes that a writer may hold at once: a slab of whole frames, and the chunk of it that is being compressed.
    attributes : dict
        The manifest, as JSON.
    mask : (height, width) bool, optional
    images : sequence of (rows, columns, 1 or 3) float32
    shares : (k, 3) int64, optional
        For each frame of a video that is used: a frame of the stack, its time in ticks, and its weight.
    strips : Strips, optional
        The pixels to store once more, for `Stack.read_strips`.

    Returns
    -------
    int
        Frames of a slab, which is written at once and is as long as a chunk. Slabs share no chunk, so they can be
        written in any order, by any worker, and repeatedly.
    """
    frames, height, width, channels = shape
    slab, edge = _slab_and_edge(shape, dtype.itemsize, memory)
    layout = MemoryStore()
    group = zarr.create_group(layout, attributes=attributes)
    stack = group.create_array(
        "frames",
        shape=shape,
        dtype=dtype,
        chunks=(slab, min(edge, height), min(edge, width), channels),
        filters=() if shares is None else FRAMES_LAST,
        compressors=FRAME_CODECS,
        dimension_names=("frame", "y", "x", "channel"),
    )
    blocks = [-(-size // thumbnail_edge(height, width)) for size in (height, width)]
    group.create_array(
        "thumbnails",
        shape=(frames, *blocks),
        dtype=np.uint16,
        chunks=(slab, *blocks),
        compressors=CODECS,
        dimension_names=("frame", "row", "column"),
    )
    whole: dict[str, Any] = {"config": EVERY_CHUNK, "compressors": CODECS}
    if strips is not None:
        rows, columns, wide = strips
        group.create_array(
            "strips",
            shape=(frames, len(rows), len(columns), channels),
            dtype=dtype,
            chunks=(slab, len(rows), min(wide, len(columns)), channels),
            compressors=FRAME_CODECS,
            attributes={"rows": rows.tolist(), "columns": columns.tolist()},
            dimension_names=("frame", "row", "column", "channel"),
        )
    if mask is not None:
        group.create_array("mask", data=mask, dimension_names=("y", "x"), **whole)
    if shares is not None:
        group.create_array("shares", data=shares, dimension_names=("share", "column"), **whole)
    for n, image in enumerate(images):
        group.create_array(f"images/{n}", data=image, dimension_names=("row", "column", "channel"), **whole)
    if _has_other_chunks(objects, capture, stack):
        # Some chunks would lie beyond the new grid, and others hide that a new one was lost. The metadata stays until
        # it is replaced, so if this is interrupted, the next call deletes the rest.
        for name in ("frames", "thumbnails", "strips"):
            objects.delete(f"{path(capture)}/{name}/c")
    objects.put_tree(path(capture), layout)
    return slab


def _slab_and_edge(shape: tuple[int, int, int, int], itemsize: int, memory: int) -> tuple[int, int]:
    """The frames of a slab, and the edge of the square of pixels that a chunk has of them.

    There is one slab, or as few as the memory allows of an even number, so that two workers take equally long. They are
    of one length but for the last. The edge doubles, beginning with that of a block (`block_edge`), until a chunk has
    about `CHUNK` bytes: a tile reads few chunks, and few bytes that it does not need.
    """
    frames, height, width, channels = shape
    pixel = channels * itemsize
    most = max(1, memory // (2 * height * width * pixel))
    slabs = -(-frames // most)
    if slabs > 1:
        slabs += slabs % 2
    slab = -(-frames // slabs)
    edge = block_edge(height, width)
    while edge < max(height, width) and 2 * slab * edge * edge * pixel <= CHUNK:
        edge *= 2
    return slab, edge


def _has_other_chunks(objects: Objects, capture: str, stack: zarr.Array[Any]) -> bool:
    """Whether the stack that a capture has in the store has another shape, or other chunks or codecs."""
    try:
        (before,) = gather(objects.array(f"{path(capture)}/frames"))
    except (FileNotFoundError, Corrupt):  # what is damaged is written again
        return False
    return any(getattr(before.metadata, name) != getattr(stack.metadata, name) for name in GRID)


def write_slab(objects: Objects, capture: str, first: int, frames: NDArray[np.unsignedinteger]) -> None:
    """Write a slab of whole frames that begins with frame ``first``, their thumbnails and their strips."""
    stack, thumbnails, strips = gather(
        objects.array(f"{path(capture)}/frames"),
        _optional(objects.array(f"{path(capture)}/thumbnails")),
        _optional(objects.array(f"{path(capture)}/strips")),
    )
    span = slice(first, first + len(frames))
    # The frames tell whether a slab is there. A stack begun by an earlier version has no thumbnails.
    if thumbnails is not None:
        thumbnails[span] = np.stack([_thumbnail(frame) for frame in frames])
    if strips is not None:
        rows, columns = (np.array(strips.attrs[name]) for name in ("rows", "columns"))
        strips[span] = frames[:, rows[:, np.newaxis], columns]
    stack[span] = frames


def thumbnail_edge(height: int, width: int) -> int:
    """The edge of a thumbnail's blocks in pixels."""
    return -(-max(height, width) // THUMBNAIL)


def thumbnail_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of a thumbnail's blocks have a pixel of a mask, (height, width), in them; (rows, columns) bool."""
    edge = thumbnail_edge(*mask.shape)
    down, across = (np.arange(0, size, edge) for size in mask.shape)
    return np.logical_or.reduceat(np.logical_or.reduceat(mask, down, axis=0), across, axis=1)


def _thumbnail(frame: NDArray[np.unsignedinteger]) -> NDArray[np.uint16]:
    """The mean values of the blocks of a frame, over its channels too, (rows, columns); 65535 is full scale."""
    height, width, channels = frame.shape
    edge = thumbnail_edge(height, width)
    down, across = (np.arange(0, size, edge) for size in (height, width))
    # 32 bits suffice for the sums of columns. For those, `reduceat` would make a copy of the frame in 32 bits.
    columns = np.stack([frame[top : top + edge].sum(axis=0, dtype=np.uint32) for top in down])
    sums = np.add.reduceat(columns, across, axis=1, dtype=np.uint64)
    counts = np.outer(np.diff(down, append=height), np.diff(across, append=width))
    scale = 65535 / (channels * np.iinfo(frame.dtype).max)
    return np.asarray(np.rint(sums.sum(axis=2) * scale / counts), np.uint16)


async def _optional(found: Coroutine[Any, Any, Any]) -> Any:
    try:
        return await found
    except FileNotFoundError:
        return None


class Stack:
    """An ingested capture, open for reading.

    Attributes
    ----------
    attributes : dict
        The manifest and the measurements, as JSON.
    frames, height, width : int
    dtype : numpy.dtype
        uint8 or uint16.
    """

    def __init__(self, objects: Objects, capture: str) -> None:
        at = path(capture)
        self._frames: zarr.Array[Any]
        self._mask: zarr.Array[Any] | None
        try:
            group, self._frames, self._mask, measured = gather(
                objects.group(at),
                objects.array(f"{at}/frames"),
                _optional(objects.array(f"{at}/mask")),
                _optional(objects.group(f"{at}/{MEASURED}")),
            )
        except FileNotFoundError as error:
            raise Corrupt(f"capture {capture} is not in the store; upload it again") from error
        self._objects, self._path = objects, at
        self._measured: dict[str, Any] = {} if measured is None else dict(measured.attrs)
        self.attributes: dict[str, Any] = dict(group.attrs) | self._measured
        self.frames, self.height, self.width, self.channels = self._frames.shape
        self.dtype = self._frames.dtype

    def read(
        self, rows: slice = slice(None), columns: slice = slice(None), frames: slice = slice(None)
    ) -> NDArray[Any]:
        """Values of a rectangle of pixels, (frame, y, x, channel).

        Raises
        ------
        Corrupt
            If one of its chunks is missing or damaged.
        """
        return np.asarray(self._frames[frames, rows, columns])

    def read_frames(self, frames: list[int], rows: slice, columns: slice) -> NDArray[Any]:
        """Like `read`, for any frames in any order."""
        if frames == list(range(frames[0], frames[-1] + 1)):  # takes half the time
            return self.read(rows, columns, slice(frames[0], frames[-1] + 1))
        return np.asarray(self._frames.oindex[np.array(frames), rows, columns])

    def read_some(
        self,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        frames: slice | NDArray[np.intp] = slice(None),
    ) -> NDArray[Any]:
        """Like `read`, for any rows, columns and frames; each chunk is read once."""
        return np.asarray(self._frames.oindex[frames, rows, columns])

    def read_strips(self, columns: slice) -> NDArray[Any] | None:
        """Like `read_some`, for the rows of the strips that `create_stack` was given, and some of their columns, but
        from few chunks; None if it was given none, or by an earlier version.
        """
        return None if self._strips is None else np.asarray(self._strips[:, :, columns])

    @cached_property
    def _strips(self) -> zarr.Array[Any] | None:
        found: zarr.Array[Any] | None
        (found,) = gather(_optional(self._objects.array(f"{self._path}/strips")))
        return found

    def read_masked(
        self, rows: slice = slice(None), columns: slice = slice(None)
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """The results of `read` and `mask`, read at the same time."""
        if self._mask is None:
            return self.read(rows, columns), self.mask(rows, columns)
        values, mask = gather(
            self._frames.async_array.getitem((slice(None), rows, columns)),
            self._mask.async_array.getitem((rows, columns)),
        )
        return values, mask

    def mask(self, rows: slice = slice(None), columns: slice = slice(None)) -> NDArray[np.bool_]:
        """Which pixels of a rectangle are to be recovered, (y, x) bool."""
        if self._mask is None:
            return np.ones((self.height, self.width), bool)[rows, columns]
        return np.asarray(self._mask[rows, columns])

    def images(self) -> list[NDArray[np.float32]]:
        """The patterns that are images, each (rows, columns, 1 or 3) float32."""
        names = self._objects.names(f"{self._path}/images")
        return [
            np.asarray(self._array(f"images/{n}")[:], np.float32)
            for n in sorted(int(name) for name in names if name != "zarr.json")
        ]

    def shares(self) -> NDArray[np.int64]:
        """The frames of a video and what they are used for, as given to `create_stack`."""
        return np.asarray(self._array("shares")[:], np.int64)

    def thumbnails(self, frames: NDArray[np.intp] | None = None) -> NDArray[np.uint16] | None:
        """The mean values of blocks of `thumbnail_edge` pixels of some frames, by default of all, (frames, rows,
        columns), 65535 being full scale; None in captures of earlier versions.
        """
        (found,) = gather(_optional(self._objects.array(f"{self._path}/thumbnails")))
        if found is None:
            return None
        return np.asarray(found[:] if frames is None else found.oindex[frames], np.uint16)

    def missing(self) -> list[int]:
        """The slabs that lack a chunk, ascending; lists the store and reads nothing."""
        stored = self._objects.paths_below(f"{self._path}/frames")
        grid = [
            range(-(-size // chunk))
            for size, chunk in zip(self._frames.shape, self._frames.chunks, strict=True)
        ]
        chunks = product(*grid)
        return sorted(
            {at[0] for at in chunks if f"{self._path}/frames/c/{'/'.join(map(str, at))}" not in stored}
        )

    def annotate(self, **attributes: Any) -> None:
        """Add measurements to the attributes; `save` stores them."""
        self._measured |= attributes
        self.attributes |= attributes

    def save(self) -> None:
        """Store the measurements with one write, so that no reader sees only some of them."""
        gather(self._objects.put_group(f"{self._path}/{MEASURED}", self._measured))

    def _array(self, name: str) -> zarr.Array[Any]:
        try:
            (array,) = gather(self._objects.array(f"{self._path}/{name}"))
        except FileNotFoundError as error:
            raise Corrupt(f"{error} of the capture is not in the store; upload it again") from error
        found: zarr.Array[Any] = array
        return found
