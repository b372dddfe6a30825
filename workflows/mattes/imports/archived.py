"""A matte in an archive on this machine, read block by block where it lies: nothing is unpacked beforehand."""

import sys
import uuid
import weakref
from pathlib import Path
from typing import Any, BinaryIO

from numpy.typing import NDArray

from storage.layout.mattes import Block
from storage.objects.store import Objects
from workflows.mattes.imports.importing import create_like
from workflows.mattes.imports.reader import Reader
from workflows.untrusted.limits import Limits

ANY_SIZE = Limits(unpacked=sys.maxsize, memory=sys.maxsize)
"""A file of their own is what people ask to open; damage and lies are refused all the same."""


class ArchivedMatte:
    """A matte in an archive. It reads like `storage.layout.mattes.Matte`, and checks what it reads.

    Parameters
    ----------
    archive : Path or BinaryIO
        A file, or an open one that is seekable.

    Attributes
    ----------
    attributes : dict
    columns, rows : int
        The first grid of T's cells.

    Raises
    ------
    ArchiveError
        If it is not the archive of a matte; says why.
    """

    def __init__(self, archive: Path | BinaryIO) -> None:
        self._archive = archive
        self._token = uuid.uuid4().hex
        if isinstance(archive, Path):
            archive = archive.open("rb")
            weakref.finalize(self, archive.close)
        self._reader = Reader(archive, ANY_SIZE)
        # Its arrays have to be those of a matte of this size, which are made in memory to compare them.
        self._empty = create_like(self._reader, Objects("memory:///"), "archive")
        self.attributes: dict[str, Any] = self._empty.attributes
        self.columns, self.rows = self._empty.columns, self._empty.rows

    def __reduce__(self) -> tuple[object, ...]:
        """In another process it is opened again."""
        return type(self), (self._archive,)

    def __dask_tokenize__(self) -> str:
        """A name of its own: dask would make one by pickling the whole file, if that is in memory."""
        return self._token

    def chunk(self, name: str, row: int, column: int) -> NDArray[Any]:
        """The values of a block in one of the frame-shaped arrays; raises `ArchiveError` if they are damaged."""
        height, width = self._size(row, column)
        return self._reader.chunk(name, row, column)[:height, :width]

    def read(self, row: int, column: int) -> Block:
        """A block; raises `ArchiveError` if something of it is damaged."""
        return self._reader.block(row, column, *self._size(row, column))

    def _size(self, row: int, column: int) -> tuple[int, int]:
        y, x = self._empty.span(row, column)
        return y.stop - y.start, x.stop - x.start
