"""The object store behind a URL, a folder or a bucket: for zarr and for plain bytes."""

from __future__ import annotations

import asyncio
import io
import shutil
import threading
import time
from contextlib import asynccontextmanager, contextmanager, suppress
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
from zarr.storage import MemoryStore, StorePath
from zarr.storage import ObjectStore as ZarrStore

from storage.objects import byte_objects, checksums, zarr_store
from storage.objects.byte_objects import PART, Writer
from storage.objects.checksums import SUFFIX
from storage.objects.retries import REQUESTS, RETRIES, translate_errors

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Coroutine, Iterable, Iterator


def gather(*work: Coroutine[Any, Any, Any]) -> list[Any]:
    """Do what does not wait for one another at once, and return what came of each.

    A bucket takes tens of milliseconds to answer, and zarr about one to go over to its thread and back. All of
    it has ended when this returns, or raises the first error.
    """
    return asyncio.run_coroutine_threadsafe(_gather(*work), _loop()).result()


async def _gather(*work: Coroutine[Any, Any, Any]) -> list[Any]:
    ended = await asyncio.gather(*work, return_exceptions=True)
    for result in ended:
        if isinstance(result, BaseException):
            raise result
    return ended


@cache
def _loop() -> asyncio.AbstractEventLoop:
    """The loop that `gather` runs on, in a thread of its own: a caller may have a loop that must not wait.

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
        checksums.configure_zarr()
        self.url = url
        self._store: ObjectStore
        self._folder: Path | None = None
        if url.startswith("file:"):
            self._folder = Path(url2pathname(urlsplit(url).path))
            # Whoever deletes the last object of a folder, zarr too, takes the folder with it.
            self._store = LocalStore.from_url(url, mkdir=True, automatic_cleanup=True)
        else:
            self._store = from_url(url, client_options=REQUESTS, retry_config=RETRIES)
        self.zarr = zarr_store.StrictStore(ZarrStore(self._store))
        # Every tile opens the same ten arrays anew, to see that they are there; to parse them takes longer.
        self._array = lru_cache(maxsize=64)(partial(zarr_store.open_array, self.zarr))

    async def group(self, path: str) -> zarr.Group:
        """The zarr group at a path, for `gather`.

        Raises
        ------
        FileNotFoundError, Corrupt
            If there is none, or it is damaged.
        """
        document = checksums.unseal(f"{path}/zarr.json", await self._document(path))[0]
        with zarr_store.translate_errors_of(path):
            return zarr.Group(zarr.AsyncGroup.from_dict(StorePath(self.zarr, path), document))

    async def array(self, path: str) -> zarr.Array[Any]:
        """The zarr array at a path, to read and to write, for `gather`.

        Raises
        ------
        FileNotFoundError, Corrupt
            If there is none, or it is damaged.
        """
        return self._array(path, await self._document(path))

    async def _document(self, path: str) -> bytes:
        document = await self.zarr.get(f"{path}/zarr.json", default_buffer_prototype())
        if document is None:
            raise FileNotFoundError(path)
        return document.to_bytes()

    async def put_group(self, path: str, attributes: dict[str, Any] | None = None) -> None:
        """Make a zarr group at a path, for `gather`; what is in it already stays."""
        document = {"zarr_format": 3, "node_type": "group", "attributes": attributes or {}}
        group = zarr.AsyncGroup.from_dict(StorePath(self.zarr, path), document)
        await self._put_metadata(path, group)

    async def put_array(self, path: str, values: NDArray[Any]) -> None:
        """Make a zarr array of one dimension and one chunk at a path, in place of an earlier one, for `gather`.

        It is what ``zarr.create_array(…, overwrite=True)`` makes there, except for the groups above it, which zarr
        would look at and make: three objects to write, and no moment in which an earlier array is gone.
        """
        n = len(values)
        shape = {
            "shape": (n,),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": (max(n, 1),)}},
        }
        array = zarr.AsyncArray.from_dict(
            StorePath(self.zarr, path), zarr_store.array_metadata(values.dtype) | shape
        )
        array = array.with_config(zarr_store.EVERY_CHUNK)
        # Without values there is no chunk.
        chunk = array.setitem(slice(None), values) if n else self.zarr.delete(f"{path}/c/0")
        await _gather(self._put_metadata(path, array), chunk)

    async def _put_metadata(self, path: str, node: zarr.AsyncGroup | zarr.AsyncArray[Any]) -> None:
        for name, document in node.metadata.to_buffer_dict(default_buffer_prototype()).items():
            await self.zarr.set(f"{path}/{name}", zarr_store.sealed(name, document))

    def put_tree(self, path: str, tree: MemoryStore) -> None:
        """Write what zarr has laid out in memory below a path; what is there besides stays."""

        async def copy() -> None:
            prototype = default_buffer_prototype()
            async for name in tree.list():
                value = await tree.get(name, prototype)
                assert value is not None
                await self.zarr.set(f"{path}/{name}", zarr_store.sealed(name, value))

        gather(copy())

    @asynccontextmanager
    async def write(self, path: str) -> AsyncIterator[Writer]:
        """A writer that streams into an object, and leaves its checksums; left by an exception it leaves no object.

        Raises
        ------
        NoRoom
            If the disk is full.
        """
        # Two parts under way bound the memory of an upload to a few parts, whatever its size.
        writer = obstore.open_writer_async(self._store, path, buffer_size=PART, max_concurrency=2)
        with translate_errors():
            async with writer as file:
                written = Writer(file)
                yield written
            with self._gone_without(path):
                await obstore.put_async(self._store, path + SUFFIX, written.table.to_bytes())

    def read(self, path: str) -> BinaryIO:
        """A seekable file over an object; reading it is `Corrupt` where it is not what was written.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        return io.BufferedReader(self.reader(path), 1 << 16)

    def reader(self, path: str) -> byte_objects.Reader:
        """The same without a buffer, for who reads from the start to the end."""
        return byte_objects.Reader(self._store, path)

    def read_raw(self, path: str, most: int | None = None) -> bytes:
        """The bytes of a small object, as they are.

        Parameters
        ----------
        most : int, optional
            Bytes that it may have.

        Raises
        ------
        FileNotFoundError
            If there is none.
        Corrupt
            If it has more.
        """
        return byte_objects.read_raw(self._store, path, most)

    def write_raw(self, path: str, pieces: Iterable[bytes]) -> None:
        """Write the pieces of an object one after another, as they are: without checksums of its own."""
        byte_objects.write_raw(self._store, path, pieces)

    def put(self, path: str, data: bytes) -> None:
        """Write a small object, whole, and its checksums.

        Raises
        ------
        NoRoom
            If the disk is full.
        """
        table = checksums.Table()
        table.update(data)
        with translate_errors():
            obstore.put(self._store, path, data)
            with self._gone_without(path):
                obstore.put(self._store, path + SUFFIX, table.to_bytes())

    @contextmanager
    def _gone_without(self, path: str) -> Iterator[None]:
        """Remove an object whose checksums can't be written: it would count as one from before there were any."""
        try:
            yield
        except BaseException:
            self.delete(path)
            raise

    async def get(self, path: str) -> bytes:
        """The bytes of a small object, for `gather`.

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
        """What lies directly in a folder, folders and objects, by name; without what holds checksums."""
        with translate_errors():
            found = obstore.list_with_delimiter(self._store, folder)
        paths = [*found["common_prefixes"], *(meta["path"] for meta in found["objects"])]
        return sorted(path.rsplit("/", 1)[-1] for path in paths if not path.endswith(SUFFIX))

    def paths_below(self, folder: str) -> set[str]:
        """The paths of all objects below a folder, however deep; without what holds checksums."""
        return {path for path in self.sizes(folder) if not path.endswith(SUFFIX)}

    def sizes(self, folder: str) -> dict[str, int]:
        """The bytes of all objects below a folder, however deep, by their paths; with what holds checksums."""
        with translate_errors():
            return {
                meta["path"]: meta["size"] for batch in obstore.list(self._store, folder) for meta in batch
            }

    def stale_names(self, folder: str, seconds: float, but: Collection[str] = ()) -> list[str]:
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
            with translate_errors():
                found = [meta for batch in obstore.list(self._store, path) for meta in batch]
                with suppress(FileNotFoundError):  # which a bucket does not list below itself
                    found.append(obstore.head(self._store, path))
            newest = max((meta["last_modified"].timestamp() for meta in found), default=-np.inf)
        return newest if newest > -np.inf else np.inf

    def delete(self, path: str) -> None:
        """Remove an object, or everything below a folder; nothing there is no error."""
        if self._folder is not None:  # with its folders, and with what was never finished, see `sweep`
            target = self._folder / path
            if target.is_dir():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)
                target.with_name(target.name + SUFFIX).unlink(missing_ok=True)
            return
        with translate_errors():
            obstore.delete(self._store, [path, path + SUFFIX])  # which a bucket does not list below itself
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

    def free_bytes(self) -> int | None:
        """Bytes that the disk of a folder has left; None for a bucket, which has no end."""
        return shutil.disk_usage(self._folder).free if self._folder is not None else None

    def check_reachable(self) -> None:
        """Reach the store once; raises whatever it raises when it can't be reached."""
        with translate_errors():
            obstore.list_with_delimiter(self._store, None)
