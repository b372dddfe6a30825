"""ZIP archives that others made, opened as hostile: bounded memory, plain names, nothing twice."""

import stat
import zipfile
import zlib
from typing import BinaryIO, cast

from storage.errors import InvalidInput

DIRECTORY_BYTES = 8 << 20
"""Of an archive's directory, which is read in one piece."""
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


def opened(file: BinaryIO, refusal: type[InvalidInput]) -> zipfile.ZipFile:
    """Open an archive.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    refusal : type
        What to raise where it is none.

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
            "this is no ZIP archive, or it is cut off: its directory can't be read. Make it again, and "
            "see that all of it is sent"
        ) from error
    bounded.most = None
    return archive


def entries(
    archive: zipfile.ZipFile, most: int, unpacked: int, refusal: type[InvalidInput]
) -> dict[str, zipfile.ZipInfo]:
    """The entries of an archive by name, none of which has been looked into.

    Parameters
    ----------
    most : int
        Entries that there may be.
    unpacked : int
        Bytes that they may unpack to, all together.
    refusal : type
        What to raise of one that can't be used.

    Raises
    ------
    InvalidInput
        Of the given type.
    """
    infos = archive.infolist()
    if len(infos) > most:
        raise refusal(f"the archive has {len(infos)} entries, more than {most}", limit=most)
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename
        if name.startswith(("/", "\\")) or ":" in name or ".." in name.replace("\\", "/").split("/"):
            raise refusal(f"{name!r} leaves the archive: use plain relative names", entry=name)
        if stat.S_ISLNK(info.external_attr >> 16):
            raise refusal(f"{name!r} is a link: put the file itself in the archive", entry=name)
        if info.flag_bits & 1:
            raise refusal(f"{name!r} is encrypted", entry=name)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            # bzip2 and LZMA unpack in zipfile without bounds.
            raise refusal(
                f"{name!r} is packed by a method other than deflate: store or deflate the entries",
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


def read(archive: zipfile.ZipFile, info: zipfile.ZipInfo, most: int, refusal: type[InvalidInput]) -> bytes:
    """The bytes of an entry, which may have at most so many.

    Raises
    ------
    InvalidInput
        Of the given type.
    """
    name = info.filename
    if info.file_size > most:
        raise refusal(
            f"{name} unpacks to {info.file_size} bytes, more than the {most} allowed for it",
            entry=name,
            limit=most,
        )
    try:
        # Not ZipFile.read, which unpacks all there is before it looks at the size that the directory gives.
        with archive.open(info) as file:
            return file.read(info.file_size)
    except UNREADABLE as error:
        raise refusal(f"{name} is damaged in the archive: {error}", entry=name) from error


class _Bounded:
    """A file of which zipfile, while it opens it, may not read as much at once as a hostile directory says."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.most: int | None = DIRECTORY_BYTES
        self.seek = file.seek
        self.tell = file.tell
        self.seekable = file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        if self.most is None:
            return self._file.read(size)
        data = self._file.read(min(size, self.most + 1) if size >= 0 else self.most + 1)
        if len(data) > self.most:
            raise zipfile.BadZipFile(f"a directory of more than {self.most} bytes")
        return data
