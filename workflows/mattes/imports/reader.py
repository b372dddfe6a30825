"""Read a matte from an untrusted archive, and check it."""

import hashlib
from functools import cache
from itertools import product
from typing import Any, BinaryIO

import numpy as np
import zarr
from numpy.typing import NDArray
from pydantic_core import from_json
from zarr.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from storage.errors import ArchiveError, Corrupt
from storage.layout import matte_archive, mattes
from storage.layout.blocks import block_edge
from storage.layout.matte_archive import GROUPS, MANIFEST
from storage.layout.mattes import CHANNELS, FRAMES, Block
from storage.objects.checksums import CODECS, is_checked, unseal
from storage.objects.zarr_store import unpack
from workflows.ingest.manifest import MANIFEST as CAPTURE
from workflows.mattes.imports.checks import faults
from workflows.mattes.imports.manifest import Attributes, Manifest, Member, valid
from workflows.recovery.pyramid import Pyramid
from workflows.untrusted import zip_files
from workflows.untrusted.limits import Limits

ENTRIES = 125_000
"""Of an archive whose directory is as large as may be."""
DOCUMENT_BYTES = 1 << 16
"""Of a zarr.json, at most."""
MEMBER_BYTES = 256
"""Of what the manifest says of one entry, at most."""
MOST_FIELDS = 20
"""Of the manifest, and of what it says of one entry."""
PIXEL_BYTES = 42
"""Of a pixel in the frame-shaped arrays."""
LIGHT_BYTES = 12
"""Of a node's light in three channels, which a composite holds."""
CHECK_BYTES = 64
"""Of a cell and its weight while they are checked."""
AGAIN = "export the matte again"


class Reader:
    """A matte in an archive. Opening it checks that the entries are those of the format; reading checks their values.

    Attributes
    ----------
    attributes : dict
        Those of the matte, as they are in the archive, within `Attributes`.
    """

    def __init__(self, file: BinaryIO, limits: Limits) -> None:
        self._limits = limits
        self._archive = zip_files.open_archive(file, ArchiveError)
        self._entries = zip_files.entries(self._archive, ENTRIES, limits.unpacked, ArchiveError)
        self._read_manifest()
        self._check_members()
        self.attributes: dict[str, Any] = self._document("zarr.json", DOCUMENT_BYTES)["attributes"]
        checked = valid(Attributes, self.attributes, "zarr.json")
        self._check_costs(checked)
        limits.check_pixels(checked.width, checked.height, entry="zarr.json")
        self._edge = block_edge(checked.height, checked.width)
        if checked.block != self._edge:
            raise refused(
                "zarr.json", f"blocks of {checked.block} pixels are not those of a frame of this size"
            )
        if self._listed != matte_archive.summary(self.attributes):
            raise refused(MANIFEST, "it lists another matte than the archive holds")
        self._nodes = Pyramid.over(checked.columns, checked.rows).nodes
        self._check_names(-(-checked.height // self._edge), -(-checked.width // self._edge))
        # As zarr stores it: a chunk is no larger than the frame.
        self._chunk = min(self._edge, checked.height), min(self._edge, checked.width)
        self._unpacked = 0
        self._checked: set[str] = set()

    def block(self, row: int, column: int, height: int, width: int) -> Block:
        """A block of height x width pixels, checked."""
        values = {name: self.chunk(name, row, column)[:height, :width] for name in FRAMES}
        count = values["count"]
        entries = int(count.sum(dtype=np.uint64))
        most = most_cells(self._limits)
        where = mattes.chunk_entry("count", row, column)
        if entries > most:
            raise ArchiveError(
                f"{where}: the rows T of this block have {entries} cells, more than the {most} allowed",
                entry=where,
                limit=most,
            )
        T = mattes.rows_folder(row, column)
        self.compare(f"{T}/zarr.json", _document_of_group())
        cell = self._rows(f"{T}/cell", entries, np.dtype("<u4"))
        weight = self._rows(f"{T}/weight", entries, np.dtype("<f4"))
        block = Block(**values, cell=cell, weight=weight)
        for name, what in faults(block, self._nodes):
            entry = f"{T}/{name}/c/0" if name in ("cell", "weight") else mattes.chunk_entry(name, row, column)
            raise refused(entry, what)
        return block

    def compare(self, name: str, ours: dict[str, Any]) -> None:
        """Check that a zarr.json equals the one written here, except that its chunks may have no checksums."""
        found = self._document(name, DOCUMENT_BYTES)
        before_checksums = ours | ({"codecs": ours["codecs"][:-1]} if "codecs" in ours else {})
        if found not in (ours, before_checksums):
            raise refused(name, "it does not describe what a matte of this size has there")
        if is_checked(found):
            self._checked.add(name.removesuffix("/zarr.json"))

    def _read_manifest(self) -> None:
        """Read what the entries are, one after another: the list of all faults takes a kilobyte for each."""
        if CAPTURE in self._entries and MANIFEST not in self._entries:
            why = "this is a capture archive: upload it, with `envmatte upload` or in the web app"
            raise ArchiveError(why, entry=MANIFEST)
        entries = len(self._entries)
        document = self._document(MANIFEST, 4096 + MEMBER_BYTES * entries, entries + MOST_FIELDS)
        members = document.get("members") if isinstance(document, dict) else None
        parts = (document, *members.values()) if isinstance(members, dict) else (document,)
        if any(isinstance(part, dict) and len(part) > MOST_FIELDS for part in parts):
            raise refused(MANIFEST, f"a part of it has more than {MOST_FIELDS} fields")
        manifest = valid(Manifest, document, MANIFEST)
        self._listed = manifest.matte
        self._members = {
            name: valid(Member, given, MANIFEST, f"members.{name}.")
            for name, given in manifest.members.items()
        }

    def chunk(self, name: str, row: int, column: int) -> NDArray[Any]:
        """The values of a block in a frame-shaped array, as large as a block inside of the frame."""
        entry = mattes.chunk_entry(name, row, column)
        dtype = np.dtype({"count": "<u4", "recovered": "u1", "shared": "u1"}.get(name, "<f4"))
        shape = (*self._chunk, 3) if name in CHANNELS else self._chunk
        values = self._decode(entry, int(np.prod(shape)), dtype).reshape(shape)
        if dtype.itemsize > 1:
            return values
        if values.max() > 1:
            raise refused(entry, "a value is neither false nor true")
        return values.view(bool)

    def _rows(self, name: str, entries: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        self.compare(f"{name}/zarr.json", _document_of_rows(entries, dtype))
        chunk = f"{name}/c/0"
        if (chunk in self._entries) != (entries > 0):
            raise refused(chunk, f"the block's counts add up to {entries}, and the chunk says otherwise")
        return self._decode(chunk, entries, dtype) if entries else np.empty(0, dtype)

    def _decode(self, name: str, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Unpack a chunk of so many values, neither more nor fewer."""
        size = count * dtype.itemsize
        self._unpacked += size
        if self._unpacked > self._limits.unpacked:
            raise ArchiveError(
                f"{name}: the matte unpacks to more than the {self._limits.unpacked} bytes allowed",
                entry=name,
                limit=self._limits.unpacked,
            )
        packed = self._read(name, size + (size >> 7) + 1024)  # what zstd makes of noise
        try:
            values = unpack(packed, size, name.partition("/c/")[0] in self._checked)
        except ValueError as error:
            raise refused(name, str(error)) from error
        if len(values) != size:
            raise refused(name, f"it unpacks to {len(values)} bytes in place of {size}")
        return np.frombuffer(values, dtype)

    def _document(self, name: str, most: int, parts: int = DOCUMENT_BYTES) -> Any:
        """The JSON of an entry, of at most so many bytes, and so many objects and lists: those take far more."""
        data = self._read(name, most)
        if data.count(b"{") + data.count(b"[") > parts:
            raise refused(name, f"it has more than {parts} parts")
        try:
            document = from_json(data, allow_inf_nan=False)
            return document if name == MANIFEST else unseal(name, data)[0]
        except ValueError as error:
            raise refused(name, "it is no JSON") from error
        except Corrupt as error:
            raise refused(name, "its checksum does not match") from error

    def _read(self, name: str, most: int) -> bytes:
        info = self._entries.get(name)
        if info is None:
            raise refused(name, "it is not in the archive")
        data = zip_files.read(self._archive, info, most, ArchiveError)
        if name != MANIFEST and hashlib.sha256(data).hexdigest() != self._members[name].sha256:
            raise refused(name, f"its checksum in {MANIFEST} does not match")
        return data

    def _check_members(self) -> None:
        """The entries are those that the manifest lists, of these sizes."""
        sizes = {name: member.size for name, member in self._members.items()}
        found = {name: info.file_size for name, info in self._entries.items() if name != MANIFEST}
        for name, size in sorted(sizes.items() ^ found.items()):
            raise refused(name, f"{MANIFEST} and the archive do not agree about it, or its {size} bytes")

    def _check_costs(self, given: Attributes) -> None:
        limits, pixels = self._limits, given.width * given.height
        frame = f"{given.width} x {given.height} pixels"
        grid = f"{given.columns} x {given.rows} cells"
        for what, cost, limit in (
            (f"a frame of {frame}", 3 * pixels, limits.image_bytes),
            (f"a matte of {frame}", PIXEL_BYTES * pixels, limits.unpacked),
            (f"a grid of {grid}", LIGHT_BYTES * given.columns * given.rows, limits.memory),
        ):
            if cost > limit:
                raise ArchiveError(
                    f"zarr.json: {what} takes {cost} bytes, more than the {limit} allowed",
                    entry="zarr.json",
                    limit=limit,
                )

    def _check_names(self, block_rows: int, block_columns: int) -> None:
        """The entries are those of a matte's format, and of one of this size."""
        if block_rows * block_columns > len(self._entries):
            raise refused("zarr.json", "the archive has fewer entries than a matte of this size")
        names = {MANIFEST, *GROUPS}
        for row, column in product(range(block_rows), range(block_columns)):
            names.update(matte_archive.block_entries(row, column))
        for name in sorted(self._entries.keys() - names):
            raise refused(name, "it is nothing that a matte of this size has")


def most_cells(limits: Limits) -> int:
    """Cells that a block may have."""
    return limits.memory // CHECK_BYTES


def refused(entry: str, what: str) -> ArchiveError:
    """What to raise of an entry."""
    return ArchiveError(f"{entry}: {what}; {AGAIN}", entry=entry)


@cache
def _document_of_group() -> dict[str, Any]:
    return _document_of(zarr.create_group(MemoryStore()))


def _document_of_rows(entries: int, dtype: np.dtype[Any]) -> dict[str, Any]:
    """The zarr.json of the cells or the weights of a block."""
    grid = {"name": "regular", "configuration": {"chunk_shape": [max(entries, 1)]}}
    return _document_of_one(dtype) | {"shape": [entries], "chunk_grid": grid}


@cache
def _document_of_one(dtype: np.dtype[Any]) -> dict[str, Any]:
    return _document_of(
        zarr.create_array(MemoryStore(), shape=(1,), chunks=(1,), dtype=dtype, compressors=CODECS)
    )


def _document_of(node: zarr.Group | zarr.Array[Any]) -> dict[str, Any]:
    document = node.metadata.to_buffer_dict(default_buffer_prototype())["zarr.json"].to_bytes()
    return unseal("zarr.json", document)[0]
