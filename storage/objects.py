"""The object store behind a URL, a folder or a bucket: for zarr and for plain bytes."""

from __future__ import annotations

import io
import shutil
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import urlsplit
from urllib.request import url2pathname

import obstore
import zarr
from obstore.store import LocalStore, ObjectStore, from_url
from zarr.storage import ObjectStore as ZarrStore
from zarr.storage import WrapperStore

from storage.errors import Corrupt

if TYPE_CHECKING:
    from obstore import AsyncWritableFile, ReadableFile
    from zarr.abc.store import ByteRequest
    from zarr.core.array_spec import ArrayConfigParams
    from zarr.core.buffer import Buffer, BufferPrototype

EVERY_CHUNK: ArrayConfigParams = {"write_empty_chunks": True}
"""For whoever makes an array: a chunk of zeros is stored like any other, so that one that is missing is damage."""
METADATA = ("zarr.json", ".zarray", ".zgroup", ".zattrs", ".zmetadata")
"""Objects that zarr looks for to see whether there is an array or a group: they may be missing."""
PART = 8 << 20
"""Bytes of one part of a large object: S3 takes parts of 5 MiB and more."""


class Objects:
    """Objects under a URL.

    Parameters
    ----------
    url : str
        ``file:///folder`` (made if it does not exist) or ``s3://bucket/prefix``.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._store: ObjectStore
        self._folder: Path | None = None
        if url.startswith("file:"):
            self._folder = Path(url2pathname(urlsplit(url).path))
            # Whoever deletes the last object of a folder, zarr too, takes the folder with it.
            self._store = LocalStore.from_url(url, mkdir=True, automatic_cleanup=True)
        else:
            self._store = from_url(url)
        self.zarr = _Whole(ZarrStore(self._store))

    def group(self, path: str) -> zarr.Group:
        """The zarr group at a path.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        return zarr.open_group(self.zarr, path=path, mode="r+")

    def array(self, path: str) -> zarr.Array[Any]:
        """The zarr array at a path, to read and to write.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        # `open_array` takes a config too, and ignores it where the array is there already.
        return zarr.open_array(self.zarr, path=path, mode="r+").with_config(EVERY_CHUNK)

    def write(self, path: str) -> AbstractAsyncContextManager[AsyncWritableFile]:
        """A writer that streams into an object; left by an exception it leaves no object."""
        # Two parts under way bound the memory of an upload to a few parts, whatever its size.
        return obstore.open_writer_async(self._store, path, buffer_size=PART, max_concurrency=2)

    def read(self, path: str) -> BinaryIO:
        """A seekable file over an object.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        return io.BufferedReader(
            _Reader(obstore.open_reader(self._store, path, buffer_size=1 << 20)), 1 << 16
        )

    def names(self, folder: str) -> list[str]:
        """What lies directly in a folder, folders and objects, by name."""
        found = obstore.list_with_delimiter(self._store, folder)
        paths = [*found["common_prefixes"], *(meta["path"] for meta in found["objects"])]
        return sorted(path.rsplit("/", 1)[-1] for path in paths)

    def below(self, folder: str) -> set[str]:
        """The paths of all objects below a folder, however deep."""
        return {meta["path"] for batch in obstore.list(self._store, folder) for meta in batch}

    def delete(self, path: str) -> None:
        """Remove an object, or everything below a folder; nothing there is no error."""
        if self._folder is not None:  # with its folders, and with what was never finished, see `sweep`
            target = self._folder / path
            shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
            return
        for batch in obstore.list(self._store, path, chunk_size=500):
            obstore.delete(self._store, [meta["path"] for meta in batch])

    def sweep(self, path: str) -> None:
        """Remove what writers that were killed have left below a folder that nobody writes to.

        In a folder of this machine an object is written beside its place, under a name with a ``#``, and
        then moved. A bucket has nothing of the kind.
        """
        if self._folder is not None:
            for part in (self._folder / path).rglob("*#*"):
                part.unlink()

    def check(self) -> None:
        """Reach the store once; raises whatever it raises when it can't be reached."""
        obstore.list_with_delimiter(self._store, None)


class _Whole(WrapperStore[ZarrStore[ObjectStore]]):
    """A store for zarr in which a missing chunk is an error: zarr reads it as its fill value, without a word."""

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        value = await self._store.get(key, prototype, byte_range)
        if value is None and not key.endswith(METADATA):
            raise Corrupt(f"{key} is missing in the store: what it belongs to is damaged, make it again")
        return value


class _Reader(io.RawIOBase):
    """obstore's reader as a raw file of the io module, which zipfile can read."""

    def __init__(self, file: ReadableFile) -> None:
        self._file = file

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        data = self._file.read(len(buffer))
        buffer[: len(data)] = memoryview(data)
        return len(data)
