"""The object store behind a URL, a folder or a bucket: for zarr and for plain bytes."""

from __future__ import annotations

import asyncio
import io
import json
import shutil
import threading
import time
from contextlib import asynccontextmanager, suppress
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import obstore
import zarr
from numpy.typing import NDArray
from obstore.store import LocalStore, ObjectStore, from_url
from zarr.buffer import default_buffer_prototype
from zarr.storage import MemoryStore, StorePath, WrapperStore
from zarr.storage import ObjectStore as ZarrStore

from storage.errors import Corrupt
from storage.outages import REQUESTS, RETRIES, told

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Coroutine

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


def together(*work: Coroutine[Any, Any, Any]) -> list[Any]:
    """Do what does not wait for one another at once, and return what came of each.

    A bucket takes tens of milliseconds to answer, and zarr about one to go over to its thread and back. All of
    it has ended when this returns, or raises the first error.
    """
    return asyncio.run_coroutine_threadsafe(_all_of(*work), _loop()).result()


async def _all_of(*work: Coroutine[Any, Any, Any]) -> list[Any]:
    ended = await asyncio.gather(*work, return_exceptions=True)
    for result in ended:
        if isinstance(result, BaseException):
            raise result
    return ended


@cache
def _loop() -> asyncio.AbstractEventLoop:
    """The loop that `together` runs on, in a thread of its own: a caller may have a loop that must not wait.

    It is kept because the threads in which zarr compresses are the loop's.
    """
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="objects", daemon=True).start()
    return loop


class Objects:
    """Objects under a URL.

    Parameters
    ----------
    url : str
        ``file:///folder`` (made if it does not exist) or ``s3://bucket/prefix``; where the bucket is and who asks say
        the environment variables ``AWS_ENDPOINT_URL``, ``AWS_REGION``, ``AWS_ACCESS_KEY_ID`` and so on.

    Notes
    -----
    Whatever reads or writes a bucket raises `Unavailable` if it can't be reached.
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
            self._store = from_url(url, client_options=REQUESTS, retry_config=RETRIES)
        self.zarr = _Whole(ZarrStore(self._store))
        # Every tile opens the same ten arrays anew, to see that they are there; to parse them takes longer.
        self._array = lru_cache(maxsize=64)(partial(_array, self.zarr))

    async def group(self, path: str) -> zarr.Group:
        """The zarr group at a path, for `together`.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        return zarr.Group(await zarr.AsyncGroup.open(StorePath(self.zarr, path), zarr_format=3))

    async def array(self, path: str) -> zarr.Array[Any]:
        """The zarr array at a path, to read and to write, for `together`.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        document = await self.zarr.get(f"{path}/zarr.json", default_buffer_prototype())
        if document is None:
            raise FileNotFoundError(path)
        return self._array(path, document.to_bytes())

    async def put_group(self, path: str, attributes: dict[str, Any] | None = None) -> None:
        """Make a zarr group at a path, for `together`; what is in it already stays."""
        document = {"zarr_format": 3, "node_type": "group", "attributes": attributes or {}}
        group = zarr.AsyncGroup.from_dict(StorePath(self.zarr, path), document)
        await self._put_metadata(path, group)

    async def put_array(self, path: str, values: NDArray[Any]) -> None:
        """Make a zarr array of one dimension and one chunk at a path, in place of an earlier one, for `together`.

        It is what ``zarr.create_array(…, overwrite=True)`` makes there, except for the groups above it, which zarr
        would look at and make: three objects to write, and no moment in which an earlier array is gone.
        """
        n = len(values)
        shape = {
            "shape": (n,),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": (max(n, 1),)}},
        }
        array = zarr.AsyncArray.from_dict(StorePath(self.zarr, path), _metadata(values.dtype) | shape)
        array = array.with_config(EVERY_CHUNK)
        # Without values there is no chunk.
        chunk = array.setitem(slice(None), values) if n else self.zarr.delete(f"{path}/c/0")
        await _all_of(self._put_metadata(path, array), chunk)

    async def _put_metadata(self, path: str, node: zarr.AsyncGroup | zarr.AsyncArray[Any]) -> None:
        for name, document in node.metadata.to_buffer_dict(default_buffer_prototype()).items():
            await self.zarr.set(f"{path}/{name}", document)

    def put_tree(self, path: str, tree: MemoryStore) -> None:
        """Write what zarr has laid out in memory below a path; what is there besides stays."""

        async def copy() -> None:
            prototype = default_buffer_prototype()
            async for name in tree.list():
                value = await tree.get(name, prototype)
                assert value is not None
                await self.zarr.set(f"{path}/{name}", value)

        together(copy())

    @asynccontextmanager
    async def write(self, path: str) -> AsyncIterator[AsyncWritableFile]:
        """A writer that streams into an object; left by an exception it leaves no object.

        Raises
        ------
        NoRoom
            If the disk is full.
        """
        # Two parts under way bound the memory of an upload to a few parts, whatever its size.
        writer = obstore.open_writer_async(self._store, path, buffer_size=PART, max_concurrency=2)
        with told():
            async with writer as file:
                yield file

    def read(self, path: str) -> BinaryIO:
        """A seekable file over an object.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        with told():
            reader = obstore.open_reader(self._store, path, buffer_size=1 << 20)
        return io.BufferedReader(_Reader(reader), 1 << 16)

    def put(self, path: str, data: bytes) -> None:
        """Write a small object, whole.

        Raises
        ------
        NoRoom
            If the disk is full.
        """
        with told():
            obstore.put(self._store, path, data)

    async def get(self, path: str) -> bytes:
        """The bytes of a small object, for `together`.

        Raises
        ------
        FileNotFoundError, Corrupt
            If there is none; the latter where it is a chunk.
        """
        value = await self.zarr.get(path, default_buffer_prototype())
        if value is None:
            raise FileNotFoundError(path)
        return value.to_bytes()

    def names(self, folder: str) -> list[str]:
        """What lies directly in a folder, folders and objects, by name."""
        with told():
            found = obstore.list_with_delimiter(self._store, folder)
        paths = [*found["common_prefixes"], *(meta["path"] for meta in found["objects"])]
        return sorted(path.rsplit("/", 1)[-1] for path in paths)

    def below(self, folder: str) -> set[str]:
        """The paths of all objects below a folder, however deep."""
        return set(self.sizes(folder))

    def sizes(self, folder: str) -> dict[str, int]:
        """The bytes of all objects below a folder, however deep, by their paths."""
        with told():
            return {
                meta["path"]: meta["size"] for batch in obstore.list(self._store, folder) for meta in batch
            }

    def stale(self, folder: str, seconds: float, but: Collection[str] = ()) -> list[str]:
        """What lies directly in a folder and was not written to for some time, by name: for whoever tidies up.

        Parameters
        ----------
        seconds : float
            How long ago the newest object of it was written, or removed from a folder of this machine. The store's
            clock says when it was, and this machine's what time it is.
        but : collection of str
            Names that are left out, and not looked at.
        """
        end = time.time() - seconds
        return [
            name
            for name in self.names(folder)
            if name not in but and self._written_at(f"{folder}/{name}") < end
        ]

    def _written_at(self, path: str) -> float:
        """When the newest object at a path or below it was written; infinity if there is none any more."""
        if self._folder is not None:  # with what is under way, see `sweep`, and folders
            newest = -np.inf
            for one in (self._folder / path, *(self._folder / path).rglob("*")):
                with suppress(FileNotFoundError):
                    newest = max(newest, one.stat().st_mtime)
        else:
            with told():
                found = [meta for batch in obstore.list(self._store, path) for meta in batch]
                with suppress(FileNotFoundError):  # which a bucket does not list below itself
                    found.append(obstore.head(self._store, path))
            newest = max((meta["last_modified"].timestamp() for meta in found), default=-np.inf)
        return newest if newest > -np.inf else np.inf

    def delete(self, path: str) -> None:
        """Remove an object, or everything below a folder; nothing there is no error."""
        if self._folder is not None:  # with its folders, and with what was never finished, see `sweep`
            target = self._folder / path
            shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
            return
        with told():
            obstore.delete(self._store, path)  # which a bucket does not list below itself
            for batch in obstore.list(self._store, path, chunk_size=500):
                obstore.delete(self._store, [meta["path"] for meta in batch])

    def sweep(self, path: str) -> None:
        """Remove what writers that were killed have left below a folder that nobody writes to.

        In a folder of this machine an object is written beside its place, under a name with a ``#``, and
        then moved. A bucket shows nothing of the kind: what it keeps of uploads that were cut off, a rule of its own
        for incomplete multipart uploads removes.
        """
        if self._folder is not None:
            for part in (self._folder / path).rglob("*#*"):
                part.unlink()

    def free(self) -> int | None:
        """Bytes that the disk of a folder has left; None for a bucket, which has no end."""
        return shutil.disk_usage(self._folder).free if self._folder is not None else None

    def check(self) -> None:
        """Reach the store once; raises whatever it raises when it can't be reached."""
        with told():
            obstore.list_with_delimiter(self._store, None)


def _array(store: _Whole, path: str, document: bytes) -> zarr.Array[Any]:
    """The array that a ``zarr.json`` describes."""
    array = zarr.AsyncArray.from_dict(StorePath(store, path), json.loads(document))
    return zarr.Array(array).with_config(EVERY_CHUNK)


@cache
def _metadata(dtype: np.dtype[Any]) -> dict[str, Any]:
    """What zarr writes down about an array of a type, for arrays of any length."""
    array = zarr.create_array(MemoryStore(), shape=(1,), chunks=(1,), dtype=dtype)
    return array.metadata.to_dict()


class _Whole(WrapperStore[ZarrStore[ObjectStore]]):
    """A store for zarr in which a missing chunk is an error: zarr reads it as its fill value, without a word.

    What can't be written or reached is told as everywhere here; these are the calls that zarr makes.
    """

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        with told():
            value = await self._store.get(key, prototype, byte_range)
        if value is None and not key.endswith(METADATA):
            raise Corrupt(f"{key} is missing in the store: what it belongs to is damaged, make it again")
        return value

    async def set(self, key: str, value: Buffer) -> None:
        with told():
            await self._store.set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        with told():
            await self._store.set_if_not_exists(key, value)

    async def delete(self, key: str) -> None:
        with told():
            await self._store.delete(key)

    async def delete_dir(self, prefix: str) -> None:
        with told():
            await self._store.delete_dir(prefix)

    async def exists(self, key: str) -> bool:
        with told():
            return await self._store.exists(key)


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
        with told():
            data = self._file.read(len(buffer))
        buffer[: len(data)] = memoryview(data)
        return len(data)
