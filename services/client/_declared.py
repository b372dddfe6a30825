"""Number and size of the frames of a capture archive, so that the service can refuse them before the upload."""

import json
import struct
import zipfile
from pathlib import Path
from typing import IO, Any

MANIFEST = "capture.json"
MANIFEST_BYTES = 8 << 20
HEAD = 1 << 16
"""Bytes of an image that are searched for its size."""
PNG = b"\x89PNG\r\n\x1a\n"
SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""JPEG markers that precede the size of a frame (ITU-T T.81, table B.1)."""


def declared(file: Path) -> dict[str, int]:
    """``frames`` of a capture, and ``width`` and ``height`` of the first if that is PNG or JPEG.

    What can't be read is left out: the service explains better what is wrong with a file.
    """
    found: dict[str, int] = {}
    try:
        with zipfile.ZipFile(file) as archive:
            if archive.getinfo(MANIFEST).file_size > MANIFEST_BYTES:
                return found
            manifest = json.loads(archive.read(MANIFEST))
            frames = manifest.get("frames") or []
            found["frames"] = len(frames) or sum(map(_patterns, manifest["program"]["parts"]))
            if frames:
                with archive.open(frames[0]["file"]) as image:
                    found |= _size(image)
    except Exception:
        pass
    return found


def _patterns(part: dict[str, Any]) -> int:
    """Number of patterns of a part of a program."""
    for name in ("levels", "colours", "files"):
        if part.get(name):
            return len(part[name])
    return int(part["count"])


def _size(image: IO[bytes]) -> dict[str, int]:
    head = image.read(HEAD)
    if head.startswith(PNG):
        width, height = struct.unpack_from(">II", head, 16)
        return {"width": width, "height": height}
    if head.startswith(b"\xff\xd8"):
        at = 2
        while head[at + 1] not in SIZES:
            at += 2 + struct.unpack_from(">H", head, at + 2)[0]
        height, width = struct.unpack_from(">HH", head, at + 5)
        return {"width": width, "height": height}
    return {}
