"""zarr arrays in the store: strict reading, checksums of metadata, and array metadata made once."""

from __future__ import annotations

from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

import imagecodecs
import numpy as np
import zarr
from obstore.store import ObjectStore
from zarr.buffer import default_buffer_prototype
from zarr.storage import MemoryStore, StorePath, WrapperStore
from zarr.storage import ObjectStore as ZarrStore

from storage.errors import Corrupt
from storage.objects import checksums
from storage.objects.checksums import CODECS
from storage.objects.retries import translate_errors

if TYPE_CHECKING:
    from collections.abc import Iterator

    from zarr.abc.store import ByteRequest
    from zarr.core.array_spec import ArrayConfigParams
    from zarr.core.buffer import Buffer, BufferPrototype

EVERY_CHUNK: ArrayConfigParams = {"write_empty_chunks": True}
"""Configuration of every array: chunks of zeros are stored too, so that a missing chunk means damage."""
METADATA = ("zarr.json", ".zarray", ".zgroup", ".zattrs", ".zmetadata")
"""Objects by which zarr finds out whether there is an array or a group: they may be missing."""


def open_array(store: StrictStore, path: str, data: bytes) -> zarr.Array[Any]:
    """The array that a ``zarr.json`` describes."""
    document, _ = checksums.unseal(f"{path}/zarr.json", data)
    with translate_metadata_errors(path):
        array = zarr.AsyncArray.from_dict(StorePath(store, path), document)
    return zarr.Array(array).with_config(EVERY_CHUNK)


@contextmanager
def translate_metadata_errors(path: str) -> Iterator[None]:
    """Raise `Corrupt` where zarr does not accept the metadata at a path."""
    try:
        yield
    except (ValueError, TypeError, KeyError) as error:
        raise checksums.damaged(f"{path}/zarr.json") from error


def sealed(name: str, value: Buffer) -> Buffer:
    """What to store under a name: a zarr.json gets its checksum."""
    if not name.endswith("zarr.json"):
        return value
    return default_buffer_prototype().buffer.from_bytes(checksums.seal(value.to_bytes()))


@cache
def array_metadata(dtype: np.dtype[Any]) -> dict[str, Any]:
    """zarr's metadata of a one-dimensional array of a type, for any length."""
    array = zarr.create_array(MemoryStore(), shape=(1,), chunks=(1,), dtype=dtype, compressors=CODECS)
    return array.metadata.to_dict()


def unpack(packed: bytes, size: int, checked: bool) -> memoryview:
    """Unpack a chunk that was packed by `CODECS`, in the calling thread.

    zarr hands each chunk from thread to thread, which takes longer than to unpack it.

    Parameters
    ----------
    packed : bytes
        The chunk.
    size : int
        Most bytes that it may unpack to.
    checked : bool
        Whether its array has checksums.

    Returns
    -------
    memoryview
        Writable, like what zarr reads.

    Raises
    ------
    ValueError
        If it is damaged; says how.
    """
    if checked:
        if not checksums.is_intact(packed):
            raise ValueError("its checksum does not match")
        packed = packed[: -checksums.SUM]
    values = memoryview(bytearray(size))
    try:
        return values[: len(imagecodecs.zstd_decode(packed, out=values))]
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"it is no chunk of {size} bytes, packed by zstd") from error


def missing_chunk(path: str) -> Corrupt:
    """The error to raise for a chunk that is not in the store."""
    return Corrupt(f"{path} is missing in the store: {checksums.remedy(path)}")


class StrictStore(WrapperStore[ZarrStore[ObjectStore]]):
    """A store for zarr in which a missing chunk is an error; zarr alone would silently read its fill value.

    It also translates the errors of the calls that zarr makes, as `storage.objects.retries` does.
    """

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        with translate_errors():
            value = await self._store.get(key, prototype, byte_range)
        if value is None and not key.endswith(METADATA):
            raise missing_chunk(key)
        return value

    async def set(self, key: str, value: Buffer) -> None:
        with translate_errors():
            await self._store.set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        with translate_errors():
            await self._store.set_if_not_exists(key, value)

    async def delete(self, key: str) -> None:
        with translate_errors():
            await self._store.delete(key)

    async def delete_dir(self, prefix: str) -> None:
        with translate_errors():
            await self._store.delete_dir(prefix)

    async def exists(self, key: str) -> bool:
        with translate_errors():
            return await self._store.exists(key)
