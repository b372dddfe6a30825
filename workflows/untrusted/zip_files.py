"""Untrusted ZIP archives, read in bounded memory: plain relative names, no duplicates, no links."""

import stat
import zipfile
import zlib
from typing import BinaryIO, cast

from storage.errors import InvalidInput
from workflows.untrusted.control_characters import CONTROL

DIRECTORY_BYTES = 8 << 20
"""The largest central directory, which zipfile reads in one piece."""
UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    ArithmeticError,
    ValueError,
    RuntimeError,
)
"""What zipfile raises on damaged entries."""


def open_archive(file: BinaryIO, refusal: type[InvalidInput]) -> zipfile.ZipFile:
    """Open an archive.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    refusal : type
        The error to raise if this is not a ZIP archive.

    Raises
    ------
    InvalidInput
        Of the given type.
    """
    bounded = _Bounded(file)
    try:
        archive = zipfile.ZipFile(cast(BinaryIO, bounded))
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise refusal(
            "this is not a ZIP archive, or it is cut off: its directory can't be read. Create it again, and "
            "check that all of it is uploaded"
        ) from error
    bounded.limit = None
    return archive


def entries(
    archive: zipfile.ZipFile, max_entries: int, unpacked: int, refusal: type[InvalidInput]
) -> dict[str, zipfile.ZipInfo]:
    """List the entries of an archive by name, without reading any of them.

    Parameters
    ----------
    max_entries : int
    unpacked : int
        Bytes that all entries may unpack to together.
    refusal : type
        The error to raise for an entry that is not allowed.

    Raises
    ------
    InvalidInput
        Of the given type.
    """
    infos = archive.infolist()
    if len(infos) > max_entries:
        raise refusal(f"the archive has {len(infos)} entries, more than {max_entries}", limit=max_entries)
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename
        if name.startswith(("/", "\\")) or ":" in name or ".." in name.replace("\\", "/").split("/"):
            raise refusal(f"{name!r} leaves the archive: use plain relative names", entry=name)
        if CONTROL.search(name):
            raise refusal(f"{name!r} has control characters: rename the file", entry=name)
        if stat.S_ISLNK(info.external_attr >> 16):
            raise refusal(f"{name!r} is a link: put the file itself in the archive", entry=name)
        if info.flag_bits & 1:
            raise refusal(f"{name!r} is encrypted: make the archive without a password", entry=name)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            # zipfile unpacks bzip2 and LZMA without bounds.
            raise refusal(
                f"{name!r} is compressed by a method other than deflate: store or deflate the entries",
                entry=name,
            )
        if name in found:
            raise refusal(f"{name!r} is in the archive twice", entry=name)
        found[name] = info
    total = sum(info.file_size for info in infos)
    if total > unpacked:
        raise refusal(
            f"the archive unpacks to {total} bytes, more than the {unpacked} allowed",
            limit=unpacked,
        )
    return found


def read(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, max_bytes: int, refusal: type[InvalidInput]
) -> bytes:
    """The bytes of an entry, ``max_bytes`` at most.

    Raises
    ------
    InvalidInput
        Of the given type.
    """
    name = info.filename
    if info.file_size > max_bytes:
        raise refusal(
            f"{name} unpacks to {info.file_size} bytes, more than the {max_bytes} allowed for it",
            entry=name,
            limit=max_bytes,
        )
    try:
        # ZipFile.read would unpack everything before it checks the size in the directory.
        with archive.open(info) as file:
            return file.read(info.file_size)
    except UNREADABLE as error:
        raise refusal(f"{name} is damaged in the archive: make the archive again", entry=name) from error


class _Bounded:
    """A file that bounds a single read while zipfile opens it, whatever size a hostile directory states."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.limit: int | None = DIRECTORY_BYTES
        self.seek = file.seek
        self.tell = file.tell
        self.seekable = file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        if self.limit is None:
            return self._file.read(size)
        data = self._file.read(min(size, self.limit + 1) if size >= 0 else self.limit + 1)
        if len(data) > self.limit:
            raise zipfile.BadZipFile(f"a directory of more than {self.limit} bytes")
        return data
