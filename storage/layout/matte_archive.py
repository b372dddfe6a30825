"""Export of a matte as one ZIP archive.

The root of the archive is the matte's zarr group, laid out as in the store (see `storage.layout.mattes`), so any zarr
reader opens it: ``zarr.open_group(zarr.storage.ZipStore("matte.zip"))``. Entries are stored without compression,
because their chunks are already compressed. Their dates are fixed and their order is block by block, so the same matte
gives the same bytes. The last entry, ``envmatte.json``, is the manifest: ``format``; ``matte``, the figures and options
to list it with; ``members``, the size and SHA-256 of every other entry.
"""

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Iterator
from itertools import accumulate, product
from typing import IO, Any, cast

from storage.errors import Corrupt
from storage.layout import mattes
from storage.layout.mattes import FRAMES, Matte, chunk_entry, rows_folder
from storage.objects.checksums import is_checked, is_intact, unseal
from storage.objects.store import Objects

FORMAT = "envmatte-archive/1"
MANIFEST = "envmatte.json"
GROUPS = ("zarr.json", "T/zarr.json", *(f"{name}/zarr.json" for name in FRAMES))
"""The entries that do not belong to a block."""
_OF_BLOCK = re.compile(r"\w+/c/(\d{1,9})/(\d{1,9})|T/(\d{1,9})\.(\d{1,9})/")
"""How the entry of a block begins: with its row and column."""
DATE = (1980, 1, 1, 0, 0, 0)
ZIP64 = (1 << 31) - 1
"""zipfile writes offsets above this in the ZIP64 format."""


def summary(attributes: dict[str, Any]) -> dict[str, Any]:
    """The part ``matte`` of the manifest of a matte with these attributes."""
    return {name: attributes[name] for name in (*mattes.FIGURES, "options")}


def block_entries(row: int, column: int) -> list[str]:
    """The entries of a block; the chunks of its rows T are missing if all of them are empty."""
    T = rows_folder(row, column)
    arrays = (f"{T}/{name}/{part}" for name in ("cell", "weight") for part in ("zarr.json", "c/0"))
    return [*(chunk_entry(name, row, column) for name in FRAMES), f"{T}/zarr.json", *arrays]


def may_lack(entry: str) -> bool:
    """Whether a matte may be without an entry of its blocks: a chunk of rows T that are all empty."""
    return entry.startswith("T/") and entry.endswith("/c/0")


def is_entry(matte: Matte, entry: str) -> bool:
    """Whether an entry is one that the archive of a matte may have, apart from the manifest."""
    found = _OF_BLOCK.match(entry)
    if not found:
        return entry in GROUPS
    row, column = (int(number) for number in found.groups() if number)
    is_block = row < matte.block_rows and column < matte.block_columns
    return is_block and entry in block_entries(row, column)


class Archive:
    """The archive of a matte in the store; iterating over it yields its bytes, one block at a time.

    Attributes
    ----------
    size : int
        Bytes of the archive.

    Raises
    ------
    Corrupt
        If an object of the matte is missing; while iterating, also if one is damaged or has been deleted. The bytes
        up to then are not a valid archive, because its directory is missing.
    """

    def __init__(self, objects: Objects, matte: str) -> None:
        opened = Matte(objects, matte)
        self._objects, self._path = objects, mattes.path(matte)
        self._record = summary(opened.attributes)
        sizes = objects.sizes(self._path)
        blocks = product(range(opened.block_rows), range(opened.block_columns))
        self._batches = [list(GROUPS), *(block_entries(*block) for block in blocks)]
        for batch in self._batches:
            lacking = {name for name in batch if may_lack(name)}
            missing = {name for name in batch if f"{self._path}/{name}" not in sizes}
            if missing and missing != lacking:
                raise self._corrupt(min(missing - lacking or missing))
            batch[:] = (name for name in batch if name not in missing)
        self._sizes = {name: sizes[f"{self._path}/{name}"] for batch in self._batches for name in batch}
        digest = "0" * hashlib.sha256().digest_size * 2
        manifest = len(self._manifest(dict.fromkeys(self._sizes, digest)))
        self.size = zip_size(self._sizes | {MANIFEST: manifest})

    def __iter__(self) -> Iterator[bytes]:
        written = _Tail()
        digests: dict[str, str] = {}
        checked: dict[str, bool] = {}
        with zipfile.ZipFile(cast(IO[bytes], written), "w") as archive:
            for batch in self._batches:
                for name, data in zip(batch, self._read(batch), strict=True):
                    folder, _, inner = name.rpartition("zarr.json" if name.endswith("zarr.json") else "c/")
                    if not inner:  # comes before the chunks that it describes
                        checked[folder] = is_checked(unseal(f"{self._path}/{name}", data)[0])
                    if len(data) != self._sizes[name] or (inner and checked[folder] and not is_intact(data)):
                        raise self._corrupt(name)
                    digests[name] = hashlib.sha256(data).hexdigest()
                    archive.writestr(_entry(name), data)
                yield written.take()
            archive.writestr(_entry(MANIFEST), self._manifest(digests))
        yield written.take()

    def _read(self, names: list[str]) -> list[bytes]:
        try:
            return self._objects.get([f"{self._path}/{name}" for name in names])
        except FileNotFoundError as error:
            raise self._corrupt(str(error)) from error

    def _manifest(self, digests: dict[str, str]) -> bytes:
        members = {
            name: {"size": self._sizes[name], "sha256": digest} for name, digest in sorted(digests.items())
        }
        return json.dumps({"format": FORMAT, "matte": self._record, "members": members}).encode()

    def _corrupt(self, name: str) -> Corrupt:
        return Corrupt(f"{name} of the matte is missing or damaged; recover the matte again")


def zip_size(sizes: dict[str, int]) -> int:
    """Bytes of a ZIP archive of stored entries, as zipfile writes it.

    Parameters
    ----------
    sizes : dict of str to int
        The bytes of each entry by its ASCII name, in order.

    Notes
    -----
    APPNOTE sect. 4.3: an entry has a local header of 30 bytes and a directory header of 46 bytes, each followed by its
    name, and 12 more bytes in the directory if it lies beyond 2 GiB. The directory ends with 22 bytes, and 76 more in
    the ZIP64 format.
    """
    starts = list(accumulate((30 + len(name) + size for name, size in sizes.items()), initial=0))
    directory = sum(46 + len(name) for name in sizes) + 12 * sum(start > ZIP64 for start in starts[:-1])
    large = len(sizes) > 0xFFFF or starts[-1] > ZIP64 or directory > ZIP64
    return starts[-1] + directory + 22 + (76 if large else 0)


def _entry(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, DATE)
    info.create_system, info.external_attr = 3, 0o644 << 16  # a Unix file, whatever the machine
    return info


class _Tail:
    """A file that holds only its end: zipfile seeks back no further than to the entry that it is writing."""

    def __init__(self) -> None:
        self._taken = 0
        self._held = io.BytesIO()

    def write(self, data: bytes) -> int:
        return self._held.write(data)

    def tell(self) -> int:
        return self._taken + self._held.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._taken + self._held.seek(offset - self._taken, whence)

    def flush(self) -> None:
        pass

    def take(self) -> bytes:
        """Return and forget the bytes written since the last call."""
        data = self._held.getvalue()
        self._taken += len(data)
        self._held = io.BytesIO()
        return data
