"""Check the LZW data of a TIFF before it is decoded.

On invalid codes, imagecodecs 2026.3, the last version for Python 3.11, follows pointers that were never written.
"""

import numpy as np
import tifffile
from numba import njit
from numpy.typing import NDArray

from storage.errors import ImageError

_CLEAR, _END, _MAX = 256, 257, 4096


def check_lzw(data: bytes, page: tifffile.TiffPage) -> None:
    """Check that every strip or tile of an LZW page uses only codes that are defined.

    Raises
    ------
    ImageError
    """
    if page.compression != tifffile.COMPRESSION.LZW:
        return
    whole = np.frombuffer(data, np.uint8)
    for start, size in zip(page.dataoffsets, page.databytecounts, strict=False):
        if not _is_valid(whole[start : start + size]):
            raise ImageError(
                "the TIFF image is cut off or damaged, its LZW has undefined codes: save it again"
            )


def load_kernel() -> None:
    """Compile what `check_lzw` runs, or load it from the cache: later this process may be unable to."""
    _is_valid(np.frombuffer(b"\x80\x40\x40", np.uint8))


@njit(nogil=True, cache=True)
def _is_valid(packed: NDArray[np.uint8]) -> bool:
    """Whether each code stands for a byte or for an entry of the table (TIFF 6.0, sect. 13).

    Notes
    -----
    Codes begin with 9 bits, most significant bit first, and get one more bit one entry before a width is exhausted.
    Each code but the first after a clear adds an entry, and may stand for that entry itself.
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
        if not is_first and entries < _MAX:
            entries += 1
        if entries + 1 >= 1 << width and width < 12:
            width += 1
        is_first = False
    return True
