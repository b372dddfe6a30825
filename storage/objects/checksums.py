"""CRC-32C checksums of everything stored: computed on writing, checked on reading.

- A chunk of an array ends with its checksum, by zarr's codec ``crc32c``, which any zarr reader checks.
- A ``zarr.json`` has its checksum as the attribute ``crc32c``: that of the document without it (`seal`). Such a
  document is one line, which tells it from older ones, which may lack a checksum.
- Other objects have one checksum for each `BLOCK` bytes, in an object beside them (`Table`), so that a range in the
  middle of gigabytes can be checked.

Objects stored before there were checksums have none and are read unchecked.
"""

import json
from collections.abc import Iterable
from typing import Any

import google_crc32c
import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.codec_pipeline import BatchedCodecPipeline
from zarr.registry import register_pipeline

from storage.errors import Corrupt

CODECS = (ZstdCodec(level=0, checksum=False), Crc32cCodec())
"""Codecs of a chunk: zarr's default compression, and the checksum."""
ATTRIBUTE = "crc32c"
"""The attribute of a zarr.json with its checksum."""
SUFFIX = ".crc32c"
"""Suffix of the object that holds the checksums of a plain object."""
BLOCK = 1 << 20
"""Bytes of a plain object for each checksum."""
UNSEALED_START = b"{\n"
"""How a zarr.json without a checksum begins, as zarr writes it."""
SUM = 4
"""Bytes of a checksum."""
Buffer = bytes | memoryview
REMEDIES = {
    "captures": "delete the capture and upload it again",
    "mattes": "delete the matte and recover, or import, it again",
    "uploads": "delete the capture, or the upload, and upload it again",
    "composites": "delete the job and composite the clip again",
}
"""What to do about a damaged object, by its top folder."""
DERIVED = "/live-"
"""Part of the path of cached textures, which are made again when needed, see `storage.layout.live`."""


def crc32c(data: Buffer, before: int = 0) -> int:
    """The CRC-32C (RFC 3720) of bytes that follow other bytes with the checksum `before`."""
    # google_crc32c takes bytes and arrays, but no memoryviews.
    return int(google_crc32c.extend(before, np.frombuffer(data, np.uint8) if len(data) else b""))


def remedy(path: str) -> str:
    """What to do about an object that is missing or damaged."""
    if DERIVED in path:
        return "view the matte live, which makes it again"
    return REMEDIES.get(path.partition("/")[0], "create it again") + ", or restore a backup"


def damaged(path: str, how: str = "checksum mismatch") -> Corrupt:
    """The error to raise for a damaged object."""
    return Corrupt(f"{path} is damaged in the store ({how}): {remedy(path)}", entry=path)


def seal(document: bytes) -> bytes:
    """Add its checksum to a zarr.json, replacing an earlier one."""
    found = _without_sum(json.loads(document))[0]
    return _dumped(found | {"attributes": {**found.get("attributes", {}), ATTRIBUTE: _sum_of(found)}})


def unseal(path: str, data: bytes) -> tuple[dict[str, Any], bool]:
    """A zarr.json without its checksum, and whether it has one.

    Raises
    ------
    Corrupt
        If it is not a JSON object, or does not match its checksum.
    """
    try:
        document, found = _without_sum(json.loads(data))
    except (ValueError, TypeError, AttributeError) as error:
        raise damaged(path, "not a JSON object") from error
    if found != _sum_of(document) and not (found is None and data.startswith(UNSEALED_START)):
        raise damaged(path)
    return document, found is not None


def _without_sum(document: dict[str, Any]) -> tuple[dict[str, Any], Any]:
    attributes = dict(document.get("attributes", {}))
    found = attributes.pop(ATTRIBUTE, None)
    return document | {"attributes": attributes}, found


def _sum_of(document: dict[str, Any]) -> str:
    return f"{crc32c(_dumped(document)):08x}"


def _dumped(document: dict[str, Any]) -> bytes:
    return json.dumps(document).encode()


def is_checked(document: dict[str, Any]) -> bool:
    """Whether chunks of the array with this zarr.json have checksums."""
    codecs = document.get("codecs") or [{}]
    return bool(codecs[-1].get("name") == "crc32c")


def is_intact(data: bytes) -> bool:
    """Whether bytes match the checksum that they end with."""
    view = memoryview(data)
    return len(data) >= SUM and crc32c(view[:-SUM]) == int.from_bytes(view[-SUM:], "little")


class Table:
    """Computes the checksums of an object's blocks while its bytes are written.

    They are stored as 4 bytes each, little-endian, followed by the checksum of them all in the same form.
    """

    def __init__(self) -> None:
        self._sums: list[int] = []
        self._size = 0

    def update(self, data: Buffer) -> None:
        """Append bytes."""
        view = memoryview(data).cast("B")
        while view:
            at = self._size % BLOCK
            part = view[: BLOCK - at]
            if not at:
                self._sums.append(0)
            self._sums[-1] = crc32c(part, self._sums[-1])
            self._size += len(part)
            view = view[len(part) :]

    def to_bytes(self) -> bytes:
        """The checksums as they are stored."""
        sums = np.array(self._sums, "<u4").tobytes()
        return sums + crc32c(sums).to_bytes(SUM, "little")


def read_table(path: str, data: bytes, size: int) -> list[int]:
    """Read the checksums of the blocks of an object of `size` bytes.

    Parameters
    ----------
    path : str
        Path of the object, for the error.

    Raises
    ------
    Corrupt
        If the table is damaged, or belongs to an object of another size.
    """
    if not is_intact(data):
        raise damaged(path + SUFFIX)
    if len(data) != SUM * (-(-size // BLOCK) + 1):
        raise damaged(path, f"it has {size} bytes, not as many as were written")
    return [int(one) for one in np.frombuffer(data[:-SUM], "<u4")]


class _NamingPipeline(BatchedCodecPipeline):
    """How zarr reads chunks, one at a time: a chunk that is damaged raises `Corrupt` with its path."""

    async def read_batch(self, batch_info: Iterable[Any], *given: Any, **more: Any) -> Any:
        batch = list(batch_info)
        try:
            return await super().read_batch(batch, *given, **more)
        # ValueError from Crc32cCodec and numpy, RuntimeError from zstd.
        except (ValueError, RuntimeError) as error:
            raise damaged(batch[0][0].path) from error


def configure_zarr() -> None:
    """Have zarr report chunks that can't be read by name, in this process: opening a store does it."""
    register_pipeline(_NamingPipeline)
    zarr.config.set({"codec_pipeline.path": f"{_NamingPipeline.__module__}.{_NamingPipeline.__qualname__}"})
