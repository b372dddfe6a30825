"""Whether LZW of a TIFF can be unpacked.

Where codes are wrong, imagecodecs 2026.3, the last for Python 3.11, follows pointers that were never written.
"""

import numpy as np
import tifffile
from numba import njit
from numpy.typing import NDArray

from storage.errors import ImageError

_CLEAR, _END, _MOST = 256, 257, 4096


def see_that_it_is_sound(data: bytes, page: tifffile.TiffPage) -> None:
    """See that every strip or tile of a page packed by LZW consists of codes that were defined before.

    Raises
    ------
    ImageError
    """
    if page.compression != tifffile.COMPRESSION.LZW:
        return
    whole = np.frombuffer(data, np.uint8)
    for start, size in zip(page.dataoffsets, page.databytecounts, strict=False):
        if not _is_sound(whole[start : start + size]):
            raise ImageError("the TIFF image is cut off or damaged: its LZW has codes that stand for nothing")


@njit(nogil=True, cache=True)
def _is_sound(packed: NDArray[np.uint8]) -> bool:
    """Whether each code is of a byte, or of an entry of the table (TIFF 6.0, sect. 13).

    Notes
    -----
    Codes have 9 bits, the highest first, and one more from the entry on that comes before the last of a width. Each but
    the first after a clear makes an entry, and may be that entry itself.
    """
    entries, width, is_first = _END + 1, 9, True
    held, bits = 0, 0
    for byte in packed:
        held, bits = (held << 8 | byte) & 0xFFFFFF, bits + 8
        if bits < width:
            continue
        bits -= width
        code = held >> bits & ((1 << width) - 1)
        if code == _END:
            return True
        if code == _CLEAR:
            entries, width, is_first = _END + 1, 9, True
            continue
        if code > (_CLEAR - 1 if is_first else entries):
            return False
        if not is_first and entries < _MOST:
            entries += 1
        if entries + 1 >= 1 << width and width < 12:
            width += 1
        is_first = False
    return True
