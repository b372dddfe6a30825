"""A matte that comes in an archive: checked as hostile, and written anew.

Nothing foreign reaches the store but values that were checked: of the archive's attributes a matte is made here, and
each block is unpacked within bounds, looked through, and written as one that was recovered here. A matte that was
exported comes back as the same bytes.

Of native code only zlib and zstd see foreign bytes here, each into a buffer whose size was checked, and in a time that
grows with it alone: unlike decoders of pictures (`services.decoding.pool`), they need no process of their own.
"""

from itertools import product
from typing import BinaryIO

from storage.layout import mattes
from storage.layout.matte_archive import GROUPS
from storage.layout.mattes import Matte
from storage.objects.checksums import unseal
from storage.objects.store import Objects
from workflows.mattes.imports.reader import Reader
from workflows.untrusted.limits import Limits


def take_in(file: BinaryIO, objects: Objects, matte: str, limits: Limits) -> Matte:
    """Make a matte of an archive; memory is that of a block, whatever the size.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    matte : str
        Id of the matte to make.
    limits : Limits
        What it may cost: bytes that all of it unpacks to, and that may be held.

    Raises
    ------
    ArchiveError
        Naming the entry that is wrong and why. Nothing of the matte is left then.
    """
    archive = Reader(file, limits)
    given = archive.attributes
    attributes = {name: given[name] for name in ("monitor", "crosstalk", "options")}
    layout = {name: given[name] for name in ("height", "width", "columns", "rows")}
    try:
        made = mattes.create(objects, matte, **layout, **attributes)
        for name in GROUPS:
            with objects.read(f"{mattes.path(matte)}/{name}") as ours:
                archive.compare(name, unseal(name, ours.read())[0])
        for row, column in product(range(made.block_rows), range(made.block_columns)):
            y, x = made.span(row, column)
            block = archive.block(row, column, y.stop - y.start, x.stop - x.start)
            made.write(row, column, block)
    except BaseException:
        objects.delete(mattes.path(matte))
        raise
    return made
