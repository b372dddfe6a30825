"""What graphics hardware draws a matte from, kept in the store beside the matte: bytes that can be made again.

In the matte's group, so that it goes with the matte, as an array of one dimension, so that it is no foreign object to
who reads the group with zarr.
"""

import numpy as np

from storage.errors import Corrupt
from storage.layout import mattes
from storage.objects.store import Objects, gather


def read(objects: Objects, matte: str, format: str) -> bytes | None:
    """What is kept of a matte in a format; None if nothing is, or not all of it yet."""
    try:
        (array,) = gather(objects.array(_path(matte, format)))
        return np.asarray(array[:], np.uint8).tobytes()
    except (FileNotFoundError, Corrupt):
        return None


def write(objects: Objects, matte: str, format: str, data: bytes) -> None:
    """Keep it, in place of an earlier one."""
    gather(objects.put_array(_path(matte, format), np.frombuffer(data, np.uint8)))


def _path(matte: str, format: str) -> str:
    return f"{mattes.path(matte)}/{format}"
