"""Checksums of what is stored, all CRC-32C, made as it is written: what has rotted is told wherever it is read.

- A chunk of an array ends with its own, by zarr's codec ``crc32c``, which any zarr reader checks.
- A ``zarr.json`` has its own among the attributes, as ``crc32c``: of the document without it (`seal`). It is one line,
  by which it is told from those of before, which may have none.
- Other objects have one for each `BLOCK` of theirs, in an object beside them (`Table`), so that a stretch in the
  middle of gigabytes is checked as it is read.

What was stored before there were checksums has none, and is read as it is.
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
"""What a chunk goes through: zarr's default, and the checksum."""
ATTRIBUTE = "crc32c"
"""Of a zarr.json: its own checksum."""
SUFFIX = ".crc32c"
"""Of the object beside a plain one that holds the table of its checksums."""
BLOCK = 1 << 20
"""Bytes of a plain object that have one checksum."""
SET_BEFORE = b"{\n"
"""How a zarr.json without a checksum begins, as zarr sets it."""
SUM = 4
"""Bytes of a checksum."""
Buffer = bytes | memoryview
REMEDIES = {
    "captures": "delete the capture and upload it again",
    "mattes": "delete the matte and recover, or import, it again",
    "uploads": "delete the capture, or the upload, and upload it again",
    "composites": "delete the job and composite the clip again",
}
"""By the folder that an object lies in."""
DERIVED = "/live-"
"""In the path of what is made again of a matte when it is needed, see `storage.layout.live`."""


def crc32c(data: Buffer, before: int = 0) -> int:
    """The CRC-32C (RFC 3720) of bytes that come after others."""
    # It takes bytes and arrays, no memoryviews.
    return int(google_crc32c.extend(before, np.frombuffer(data, np.uint8) if len(data) else b""))


def remedy(path: str) -> str:
    """What to do about an object that is missing or damaged."""
    if DERIVED in path:
        return "look at the matte live: it is made again"
    return REMEDIES.get(path.partition("/")[0], "make it again") + ", or restore a backup"


def damaged(path: str, how: str = "it is not what was written") -> Corrupt:
    """What to raise of an object that can't be used any more."""
    return Corrupt(f"{path} is damaged in the store, {how}: {remedy(path)}", entry=path)


def seal(document: bytes) -> bytes:
    """A zarr.json with its checksum, in place of an earlier one."""
    found = _without_sum(json.loads(document))[0]
    return _dumped(found | {"attributes": {**found.get("attributes", {}), ATTRIBUTE: _sum_of(found)}})


def unseal(path: str, data: bytes) -> tuple[dict[str, Any], bool]:
    """What a zarr.json says without its checksum, and whether it has one.

    Raises
    ------
    Corrupt
        If it is no JSON object, or not the one that was written.
    """
    try:
        document, found = _without_sum(json.loads(data))
    except (ValueError, TypeError, AttributeError) as error:
        raise damaged(path, "it is no JSON object any more") from error
    if found != _sum_of(document) and not (found is None and data.startswith(SET_BEFORE)):
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
    """Whether the chunks of an array with this zarr.json have a checksum."""
    codecs = document.get("codecs") or [{}]
    return bool(codecs[-1].get("name") == "crc32c")


def is_intact(data: bytes) -> bool:
    """Whether bytes that end with their checksum are what was written."""
    view = memoryview(data)
    return len(data) >= SUM and crc32c(view[:-SUM]) == int.from_bytes(view[-SUM:], "little")


class Table:
    """The checksums of an object's blocks, made as its bytes go by.

    Written down they are 4 bytes each, little-endian, one after another; then, in the same way, their own.
    """

    def __init__(self) -> None:
        self._sums: list[int] = []
        self._size = 0

    def update(self, data: Buffer) -> None:
        """Take in the bytes that come next."""
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
        """As it is written down."""
        sums = np.array(self._sums, "<u4").tobytes()
        return sums + crc32c(sums).to_bytes(SUM, "little")


def read_table(path: str, data: bytes, size: int) -> list[int]:
    """The checksums of the blocks of an object of so many bytes.

    Parameters
    ----------
    path : str
        The object's, for the error.

    Raises
    ------
    Corrupt
        If that is no table of theirs.
    """
    if not is_intact(data):
        raise damaged(path + SUFFIX)
    if len(data) != SUM * (-(-size // BLOCK) + 1):
        raise damaged(path, f"it has {size} bytes and another number was written")
    return [int(one) for one in np.frombuffer(data[:-SUM], "<u4")]


class _Named(BatchedCodecPipeline):
    """How zarr reads chunks, one at a time: one that can't be decoded, or fails its checksum, is `Corrupt` by name."""

    async def read_batch(self, batch_info: Iterable[Any], *given: Any, **more: Any) -> Any:
        batch = list(batch_info)
        try:
            return await super().read_batch(batch, *given, **more)
        except (ValueError, RuntimeError) as error:  # of Crc32cCodec, of numpy; of zstd
            raise damaged(batch[0][0].path) from error


def configure_zarr() -> None:
    """Have zarr report chunks that can't be read by name, in this process: opening a store does it."""
    register_pipeline(_Named)
    zarr.config.set({"codec_pipeline.path": f"{_Named.__module__}.{_Named.__qualname__}"})
