"""The object store, a folder or a bucket: zarr arrays and plain bytes."""

from __future__ import annotations

import errno
import io
import secrets
import shutil
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import lru_cache, partial
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

from storage import disks
from storage.errors import StoreUnavailable
from storage.objects import byte_objects, checksums, zarr_store
from storage.objects.byte_objects import PART, Writer
from storage.objects.checksums import SUFFIX
from storage.objects.event_loop import finish_all, gather
from storage.objects.retries import REQUESTS, RETRIES, translate_errors

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator, Sequence

    from obstore.store import ClientConfig


TRIES = 20
"""How often a folder is removed that others write into meanwhile, as the live form of a matte that is being viewed."""
CROSSED = (errno.ENOENT, errno.ENOTEMPTY, errno.EISDIR)
"""Errors of a removal that others have crossed."""


def folder_of(url: str) -> Path | None:
    """The folder that a URL of objects names; None for a bucket."""
    return Path(url2pathname(urlsplit(url).path)) if url.startswith("file:") else None


class Objects:
    """Objects under a URL, in a folder or a bucket.

    Parameters
    ----------
    url : str
        ``file:///folder`` (created if it does not exist) or ``s3://bucket/prefix``. The environment variables
        ``AWS_ENDPOINT_URL``, ``AWS_REGION``, ``AWS_ACCESS_KEY_ID`` and so on configure access to a bucket. Objects
        under ``http://`` can only be read, and those in ``memory:///`` end with this.
    key : str, optional
        API key that goes with requests to ``http://``.

    Raises
    ------
    StoreUnavailable
        If the folder cannot be created.

    Notes
    -----
    All methods that access a bucket raise `StoreUnavailable` if it cannot be reached.
    """

    def __init__(self, url: str, key: str | None = None) -> None:
        checksums.configure_zarr()
        self.url = url
        self.installation: str | None = None
        """What the store is recognised by once it has been found to be right, see `storage.objects.marker`."""
        self._store: ObjectStore
        self._folder = folder_of(url)
        if self._folder is not None:
            # Deleting the last object of a folder, also by zarr, deletes the folder.
            try:
                self._store = LocalStore.from_url(url, mkdir=True, automatic_cleanup=True)
            except OSError as error:
                raise StoreUnavailable(
                    f"cannot open the store {url}: {error}; name a folder that can be made (--store, ENVMATTE_STORE)"
                ) from error
        else:
            headers: ClientConfig = {"default_headers": {"Authorization": f"Bearer {key}"}} if key else {}
            self._store = from_url(url, client_options=REQUESTS | headers, retry_config=RETRIES)
        self.zarr = zarr_store.StrictStore(ZarrStore(self._store))
        # Each tile reads the metadata of the same ten arrays again, to check that they exist; parsing it takes longer.
        self._array = lru_cache(maxsize=64)(partial(zarr_store.open_array, self.zarr))

    async def group(self, path: str) -> zarr.Group:
        """The zarr group at a path, for `gather`.

        Raises
        ------
        FileNotFoundError
            If there is none.
        Corrupt
            If it is damaged.
        """
        document = checksums.unseal(f"{path}/zarr.json", await self._get(f"{path}/zarr.json"))[0]
        with zarr_store.translate_metadata_errors(path):
            return zarr.Group(zarr.AsyncGroup.from_dict(StorePath(self.zarr, path), document))

    async def array(self, path: str) -> zarr.Array[Any]:
        """The zarr array at a path, for reading and writing, for `gather`.

        Raises
        ------
        FileNotFoundError
            If there is none.
        Corrupt
            If it is damaged.
        """
        return self._array(path, await self._get(f"{path}/zarr.json"))

    async def put_group(self, path: str, attributes: dict[str, Any] | None = None) -> None:
        """Create a zarr group at a path, for `gather`; its members stay."""
        document = {"zarr_format": 3, "node_type": "group", "attributes": attributes or {}}
        group = zarr.AsyncGroup.from_dict(StorePath(self.zarr, path), document)
        await self._put_metadata(path, group)

    async def put_array(self, path: str, values: NDArray[Any]) -> None:
        """Write a one-dimensional zarr array of one chunk at a path, replacing an earlier one, for `gather`.

        The result equals that of ``zarr.create_array(…, overwrite=True)``, but zarr would also look up and create the
        groups above, and would first delete the earlier array.
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
        # An empty array has no chunk.
        chunk = array.setitem(slice(None), values) if n else self.zarr.delete(f"{path}/c/0")
        await finish_all(self._put_metadata(path, array), chunk)

    async def _put_metadata(self, path: str, node: zarr.AsyncGroup | zarr.AsyncArray[Any]) -> None:
        for name, document in node.metadata.to_buffer_dict(default_buffer_prototype()).items():
            await self.zarr.set(f"{path}/{name}", zarr_store.sealed(name, document))

    def put_tree(self, path: str, tree: MemoryStore) -> None:
        """Copy a zarr hierarchy from memory to a path; other objects below the path stay."""

        async def copy() -> None:
            prototype = default_buffer_prototype()
            async for name in tree.list():
                value = await tree.get(name, prototype)
                assert value is not None
                await self.zarr.set(f"{path}/{name}", zarr_store.sealed(name, value))

        gather(copy())

    @asynccontextmanager
    async def write(self, path: str) -> AsyncIterator[Writer]:
        """A writer that streams into an object and stores its checksums; after an exception there is no object.

        Raises
        ------
        NoRoom
            If the disk is full.
        """
        # Two concurrent requests bound the memory of an upload to a few parts, whatever its size.
        writer = obstore.open_writer_async(self._store, path, buffer_size=PART, max_concurrency=2)
        with translate_errors():
            async with writer as file:
                written = Writer(file)
                yield written
            with self._delete_without_checksums(path):
                await obstore.put_async(self._store, path + SUFFIX, written.table.to_bytes())

    def read(self, path: str) -> BinaryIO:
        """A seekable file over an object; reading raises `Corrupt` where the object is damaged.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """
        return io.BufferedReader(self.reader(path), 1 << 16)

    def reader(self, path: str) -> byte_objects.Reader:
        """Like `read`, without a buffer: for reading from the beginning to the end."""
        return byte_objects.Reader(self._store, path)

    def read_raw(self, path: str, most: int | None = None) -> bytes:
        """The bytes of a small object, without checking them.

        Parameters
        ----------
        most : int, optional
            Most bytes that it may have.

        Raises
        ------
        FileNotFoundError
            If there is none.
        Corrupt
            If it has more bytes.
        """
        return byte_objects.read_raw(self._store, path, most)

    def write_raw(self, path: str, pieces: Iterable[bytes]) -> None:
        """Write an object piece by piece, without storing checksums; after an exception there is no object."""
        byte_objects.write_raw(self._store, path, pieces)

    def put(self, path: str, data: bytes | memoryview) -> None:
        """Write a small object and its checksums.

        Raises
        ------
        NoRoom
            If the disk is full.
        """
        table = checksums.Table()
        table.update(data)
        with translate_errors():
            obstore.put(self._store, path, data)
            with self._delete_without_checksums(path):
                obstore.put(self._store, path + SUFFIX, table.to_bytes())

    @contextmanager
    def _delete_without_checksums(self, path: str) -> Iterator[None]:
        """Remove an object whose checksums cannot be written: it would count as one without checksums."""
        try:
            yield
        except BaseException:
            self.delete(path)
            raise

    def get(self, paths: Sequence[str]) -> list[bytes]:
        """The bytes of small objects, without checking them.

        A bucket is asked for all of them at once. Files are read one after another by the calling thread, which takes
        less time than to hand them over to `gather`.

        Raises
        ------
        FileNotFoundError
            If metadata of zarr is not there.
        Corrupt
            If another object is not there: it should be a chunk of an array.
        """
        if self._folder is None:
            return gather(*(self._get(path) for path in paths))
        found = []
        for path in paths:
            try:
                found.append(self.read_raw(path))
            except FileNotFoundError as error:
                if path.endswith(zarr_store.METADATA):
                    raise
                raise zarr_store.missing_chunk(path) from error
        return found

    async def _get(self, path: str) -> bytes:
        value = await self.zarr.get(path, default_buffer_prototype())
        if value is None:
            raise FileNotFoundError(path)
        return value.to_bytes()

    def names(self, folder: str) -> list[str]:
        """Names of the folders and objects directly in a folder, sorted; without tables of checksums."""
        with translate_errors():
            found = obstore.list_with_delimiter(self._store, folder)
        paths = [*found["common_prefixes"], *(meta["path"] for meta in found["objects"])]
        return sorted(path.rsplit("/", 1)[-1] for path in paths if not path.endswith(SUFFIX))

    def paths_below(self, folder: str) -> set[str]:
        """Paths of all objects below a folder, at any depth; without tables of checksums."""
        return {path for path in self.sizes(folder) if not path.endswith(SUFFIX)}

    def sizes(self, folder: str) -> dict[str, int]:
        """Sizes in bytes of all objects below a folder, at any depth, by path; with tables of checksums."""
        with translate_errors():
            return {
                meta["path"]: meta["size"] for batch in obstore.list(self._store, folder) for meta in batch
            }

    def clock(self) -> float:
        """The time by the clock that dates objects of this store; a bucket's has whole seconds."""
        probe = f"clock-{secrets.token_hex(8)}"
        with translate_errors():
            obstore.put(self._store, probe, b"")
        try:
            return self.written_at(probe)
        finally:
            self.delete(probe)

    def written_at(self, path: str) -> float:
        """When the newest object at or below a path was written; infinity if there is none any more."""
        if self._folder is not None:  # unfinished files (see `sweep`) and folders count too
            newest = -np.inf
            for one in (self._folder / path, *(self._folder / path).rglob("*")):
                with suppress(FileNotFoundError):
                    newest = max(newest, one.stat().st_mtime)
        else:
            with translate_errors():
                found = [meta for batch in obstore.list(self._store, path) for meta in batch]
                with suppress(FileNotFoundError):  # a bucket does not list an object below its own path
                    found.append(obstore.head(self._store, path))
            newest = max((meta["last_modified"].timestamp() for meta in found), default=-np.inf)
        return newest if newest > -np.inf else np.inf

    def delete(self, path: str) -> None:
        """Remove an object, or everything below a folder; it is not an error if there is nothing."""
        if self._folder is not None:  # with its folders and unfinished files, see `sweep`
            target = self._folder / path
            _remove(target)
            _remove(target.with_name(target.name + SUFFIX))
            return
        with translate_errors():
            # A bucket does not list an object below its own path.
            obstore.delete(self._store, [path, path + SUFFIX])
            for batch in obstore.list(self._store, path, chunk_size=500):
                obstore.delete(self._store, [meta["path"] for meta in batch])

    def sweep(self, path: str, before: float = np.inf) -> None:
        """Remove what killed writers have left below a folder, if it was written before a time by the store's clock.

        In a local folder, an object is first written to a file with ``#`` in its name and then renamed. A bucket has no
        such objects; incomplete multipart uploads are removed by a lifecycle rule of the bucket.
        """
        if self._folder is not None:
            for part in (self._folder / path).rglob("*#*"):
                with suppress(FileNotFoundError):
                    if part.stat().st_mtime < before:
                        part.unlink()

    def free_bytes(self) -> int | None:
        """Free bytes on the disk of a folder; None for a bucket, which has no limit."""
        return shutil.disk_usage(self._folder).free if self._folder is not None else None

    def spare_bytes(self) -> int | None:
        """Bytes that uploads may still take of the disk of a folder, see `storage.disks`; None for a bucket."""
        return disks.spare_bytes(self._folder) if self._folder is not None else None

    def require_reserve(self) -> None:
        """Check that the disk of a folder has room for jobs, see `storage.disks`.

        Raises
        ------
        NoRoom
        """
        if self._folder is not None:
            disks.require_reserve(self._folder)

    def check_reachable(self) -> None:
        """Send the store one request, which raises an error if the store cannot be reached."""
        with translate_errors():
            obstore.list_with_delimiter(self._store, None)


def _remove(path: Path) -> None:
    """Remove a file, or a folder with everything in it, also if others write into it or remove it meanwhile."""
    for _ in range(TRIES):
        try:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            if error.errno not in CROSSED:
                raise
        if not path.exists():
            return
    raise OSError(errno.ENOTEMPTY, "objects are written faster than they can be removed", str(path))
