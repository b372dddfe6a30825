"""Textures from which graphics hardware draws a matte, cached in the store.

They lie in the matte's group, so that they are deleted with it, each as a one-dimensional array, so that any zarr
reader can read the group.
"""

import numpy as np

from storage.errors import Corrupt
from storage.layout import mattes
from storage.objects.event_loop import gather
from storage.objects.store import Objects


def read(objects: Objects, matte: str, format: str) -> bytes | None:
    """The cached textures of a matte in a format; None if they are missing or incomplete."""
    try:
        (array,) = gather(objects.array(_path(matte, format)))
        return np.asarray(array[:], np.uint8).tobytes()
    except (FileNotFoundError, Corrupt):
        return None


def write(objects: Objects, matte: str, format: str, data: bytes) -> None:
    """Cache the textures of a matte in a format, replacing earlier ones."""
    gather(objects.put_array(_path(matte, format), np.frombuffer(data, np.uint8)))


def _path(matte: str, format: str) -> str:
    return f"{mattes.path(matte)}/{format}"
