"""Which files are camera RAW. By their bytes, many are TIFFs that begin with a thumbnail."""

import io
from collections.abc import Iterator
from itertools import islice
from pathlib import PurePosixPath

import tifffile

SUFFIXES = (
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw",
    ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
)  # fmt: skip
"""Extensions of RAW files."""
MAGICS = (
    b"FUJIFILMCCD-RAW",  # Fuji
    b"II*\0\x10\0\0\0CR",  # Canon CR2
    b"II\x1a\0\0\0HEAPCCDR",  # Canon CRW
    b"IIRO",  # Olympus, as the next two
    b"IIRS",
    b"MMOR",
    b"IIU\0",  # Panasonic
    b"FOVb",  # Sigma
    b"\0MRM",  # Minolta
)
"""First bytes of RAW files that are no plain TIFF."""
CR3 = b"ftypcrx "
"""Bytes 4 to 12 of Canon's newer RAW."""
FILTERED = {tifffile.PHOTOMETRIC.CFA, tifffile.PHOTOMETRIC.LINEAR_RAW}
"""Photometric interpretations of a TIFF's images that only RAW files have."""
_VERSION = 50706  # the tag of a DNG's version
_REDUCED = 1  # the bit of a TIFF's subfile type that says that an image is a smaller copy of another
_IMAGES = 16  # images of a file that are examined


def is_raw(data: bytes, name: str = "") -> bool:
    """Whether a file is camera RAW, judging by its name if it has one, and by its first image.

    Many RAW files are TIFFs that begin with a thumbnail, which must not be taken for the picture.
    """
    if PurePosixPath(name).suffix.lower() in SUFFIXES or data.startswith(MAGICS) or data[4:12] == CR3:
        return True
    if not data.startswith((b"II*\0", b"MM\0*")):
        return False
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            first = file.pages[0]
            if _VERSION in first.tags or first.subfiletype & _REDUCED:
                return True
            return any(page.photometric in FILTERED for page in images(first))
    except Exception:  # damaged bytes raise many kinds of errors
        return False


def images(first: tifffile.TiffPage) -> Iterator[tifffile.TiffPage]:
    """The first image of a TIFF, and those that it refers to."""
    yield first
    yield from islice(first.pages or (), _IMAGES)
