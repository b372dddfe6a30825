"""Write EXR files band by band: however large, they take little memory, and end when nobody wants them any more.

OpenEXR's own module takes whole pictures, and nothing else of a process goes on while it packs them. The files here
have one part of scan lines, with ZIP compression, as "The OpenEXR file layout" (openexr.com) describes them.
"""

import struct
from collections.abc import Iterable, Mapping
from typing import IO, Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from workflows.interruption import checkpoint

LINES = 16
"""Lines of a chunk: this compression packs so many together."""
LEVEL = 4
"""Of compression: higher ones take longer for a few per cent."""
Types = Mapping[str, type[np.float16] | type[np.float32]]
_MAGIC = b"v/1\x01\x02\x00\x00\x00"  # and version 2, one part, scan lines, short names
_ZIP = 3
_INCREASING = 0
_PIXEL_TYPES = {np.float16: 1, np.float32: 2}


def write_exr(
    file: IO[bytes],
    width: int,
    height: int,
    types: Types,
    bands: Iterable[Mapping[str, NDArray[Any]]],
    header: Mapping[str, Any] | None = None,
) -> None:
    """Write an EXR.

    Parameters
    ----------
    file : IO[bytes]
        Empty, and seekable.
    width, height : int
    types : mapping of str to type
        The channels by name, such as ``R`` or ``lobe0.u``, and the type of each: numpy.float16 or numpy.float32.
    bands : iterable of mappings of str to (rows, width) arrays
        The rows of all channels from the top. Each band but the last has a multiple of `LINES` rows.
    header : mapping, optional
        Further attributes: text, a pair of integers, a (3, 3) array, or x and y of three primaries and of white, (8,).
    """
    names = sorted(types)
    corners = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes: dict[str, tuple[str, bytes]] = {
        "channels": ("chlist", b"".join(_channel(name, types[name]) for name in names) + b"\0"),
        "compression": ("compression", bytes([_ZIP])),
        "dataWindow": ("box2i", corners),
        "displayWindow": ("box2i", corners),
        "lineOrder": ("lineOrder", bytes([_INCREASING])),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)),
        "screenWindowCenter": ("v2f", struct.pack("<2f", 0, 0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
    }
    attributes |= {name: _typed(value) for name, value in (header or {}).items()}
    file.write(_MAGIC)
    for name, (kind, value) in attributes.items():
        file.write(b"%s\0%s\0%s%s" % (name.encode(), kind.encode(), struct.pack("<i", len(value)), value))
    file.write(b"\0")
    table, offsets = file.tell(), np.zeros(-(-height // LINES), "<u8")
    file.write(offsets.tobytes())
    line = 0
    for band in bands:
        for first in range(0, len(band[names[0]]), LINES):
            checkpoint()
            lines = [band[name][first : first + LINES].astype(types[name], copy=False) for name in names]
            packed = _pack(lines)
            offsets[line // LINES] = file.tell()
            file.write(struct.pack("<2i", line, len(packed)))
            file.write(packed)
            line += len(lines[0])
    end = file.tell()
    file.seek(table)
    file.write(offsets.tobytes())
    file.seek(end)


def _channel(name: str, kind: type[np.float16] | type[np.float32]) -> bytes:
    """An entry of the list of channels, without subsampling."""
    return struct.pack(f"<{len(name)}sxi4x2i", name.encode(), _PIXEL_TYPES[kind], 1, 1)


def _typed(value: Any) -> tuple[str, bytes]:
    """The type and the bytes of an attribute."""
    if isinstance(value, str):
        return "string", value.encode()
    if isinstance(value, np.ndarray):
        return "m33f" if value.ndim == 2 else "chromaticities", value.astype("<f4").tobytes()
    return "v2i", struct.pack("<2i", *value)


def _pack(lines: list[NDArray[Any]]) -> bytes:
    """Pack some lines of all channels: the lower bytes before the higher ones, and the differences between them."""
    of_channels = [np.ascontiguousarray(values).view(np.uint8) for values in lines]
    plain = np.concatenate(of_channels, axis=1).reshape(-1)
    sorted_bytes = np.concatenate([plain[::2], plain[1::2]])
    steps = np.diff(sorted_bytes, prepend=np.uint8(0)) + np.uint8(128)
    steps[0] = sorted_bytes[0]
    packed = bytes(imagecodecs.deflate_encode(steps.tobytes(), level=LEVEL))
    return packed if len(packed) < plain.size else plain.tobytes()
