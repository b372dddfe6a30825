"""Import a matte from an archive, which is untrusted.

Only checked values reach the store. A new matte is created from the archive's attributes; each block is unpacked within
bounds, checked, and written like a block that was recovered here. An exported matte comes back as the same bytes.

The only native code that reads untrusted bytes is zlib and zstd. Both write to a buffer of checked size, in time that
grows only with that size, so unlike images (`workflows.untrusted.decoder`) they need no process of their own.
"""

from itertools import product
from typing import BinaryIO

from storage.layout import mattes
from storage.layout.matte_archive import GROUPS
from storage.layout.mattes import Matte
from storage.objects.checksums import unseal
from storage.objects.store import Objects
from workflows.interruption import checkpoint
from workflows.mattes.imports.reader import Reader, most_cells
from workflows.untrusted.limits import Limits

CELL_BYTES = 24
"""Of a cell and its weight, packed, unpacked and while they are checked; 22 measured."""
DIRECTORY_BYTES = 200 << 20
"""Of the largest directory and manifest, which are read before any block; 201 MB measured."""


def bytes_of_import(limits: Limits) -> int:
    """Bytes of memory that `take_in` takes at most."""
    return max(DIRECTORY_BYTES, CELL_BYTES * most_cells(limits))


def take_in(file: BinaryIO, objects: Objects, matte: str, limits: Limits) -> Matte:
    """Create a matte from an archive. Memory use is that of one block, whatever the size.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    matte : str
        Id of the matte to make.
    limits : Limits
        Most bytes that the archive may unpack to, and that may be held in memory.

    Raises
    ------
    ArchiveError
        Names the entry that is wrong, and why. The matte is deleted.
    OverLimit
        If its frame has more pixels than the limits allow.
    """
    archive = Reader(file, limits)
    try:
        made = create_like(archive, objects, matte)
        for row, column in product(range(made.block_rows), range(made.block_columns)):
            checkpoint()
            y, x = made.span(row, column)
            block = archive.block(row, column, y.stop - y.start, x.stop - x.start)
            made.write(row, column, block)
    except BaseException:
        objects.delete(mattes.path(matte))
        raise
    return made


def create_like(archive: Reader, objects: Objects, matte: str) -> Matte:
    """Create the matte of an archive without its blocks; raises `ArchiveError` if its arrays differ from ours."""
    given = archive.attributes
    names = ("monitor", "crosstalk", "options", "interval", "beside")
    attributes = {name: given[name] for name in names if name in given}
    layout = {name: given[name] for name in ("height", "width", "columns", "rows")}
    made = mattes.create(objects, matte, **layout, **attributes)
    for name in GROUPS:
        with objects.read(f"{mattes.path(matte)}/{name}") as ours:
            archive.compare(name, unseal(name, ours.read())[0])
    return made
