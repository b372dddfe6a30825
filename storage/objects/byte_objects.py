"""Plain byte objects: written with a table of checksums beside them, and checked block by block when read."""

import io
from collections.abc import Iterable
from typing import TYPE_CHECKING

import obstore
from obstore.store import ObjectStore

from storage.objects.checksums import BLOCK, SUFFIX, Buffer, Table, crc32c, damaged, read_table
from storage.objects.retries import translate_errors

if TYPE_CHECKING:
    from obstore import AsyncWritableFile

PART = 8 << 20
"""Bytes of a part of a multipart upload: S3 requires at least 5 MiB."""


class Writer:
    """Streams bytes into an object and computes their checksums."""

    def __init__(self, file: "AsyncWritableFile") -> None:
        self._file = file
        self.table = Table()

    async def write(self, data: Buffer) -> None:
        """Append bytes."""
        self.table.update(data)
        await self._file.write(data)


class Reader(io.RawIOBase):
    """An object as a raw file of the io module, for zipfile for example; each block is checked when it is read.

    Raises
    ------
    FileNotFoundError
        If there is no such object.
    Corrupt
        If a block is damaged; raised when it is read.
    """

    def __init__(self, store: ObjectStore, path: str) -> None:
        self._store, self._path = store, path
        with translate_errors():
            self.size: int = obstore.head(store, path)["size"]
        try:
            self._sums: list[int] | None = read_table(path, read_raw(store, path + SUFFIX), self.size)
        except FileNotFoundError:  # stored before there were checksums
            self._sums = None
        self._at = 0
        self._block = (-1, memoryview(b""))

    @property
    def is_checked(self) -> bool:
        """Whether the object has checksums."""
        return self._sums is not None

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        at = (0, self._at, self.size)[whence] + offset
        if at < 0:
            raise ValueError(f"seek to {at}, before the start")
        self._at = at
        return at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        if self._at >= self.size:
            return 0
        n, start = divmod(self._at, BLOCK)
        if self._block[0] != n:
            self._block = n, self._read(n)
        data = self._block[1][start : start + len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def _read(self, n: int) -> memoryview:
        length = min(BLOCK, self.size - n * BLOCK)
        with translate_errors():
            data = memoryview(obstore.get_range(self._store, self._path, start=n * BLOCK, length=length))
        if self._sums is not None and crc32c(data) != self._sums[n]:
            raise damaged(self._path)
        return data


def read_raw(store: ObjectStore, path: str, most: int | None = None) -> bytes:
    """See `storage.objects.store.Objects.read_raw`."""
    with translate_errors():
        found = obstore.get(store, path)
        if most is not None and found.meta["size"] > most:
            raise damaged(path, f"it has more than {most} bytes")
        return found.bytes().to_bytes()


def write_raw(store: ObjectStore, path: str, pieces: Iterable[bytes]) -> None:
    """See `storage.objects.store.Objects.write_raw`."""
    taken = iter(pieces)
    first = next(taken, b"")
    second = next(taken, None)
    with translate_errors():
        if second is None:  # most objects are one piece, which takes one request
            obstore.put(store, path, first)
            return
        with obstore.open_writer(store, path, buffer_size=PART, max_concurrency=2) as file:
            file.write(first)
            file.write(second)
            for piece in taken:
                file.write(piece)
