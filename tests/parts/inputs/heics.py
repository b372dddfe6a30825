"""HEICs that tests make."""

import io
from typing import Any

import numpy as np
import pillow_heif
from numpy.typing import NDArray
from PIL import Image

MODES = {1: "L", 3: "RGB", 4: "RGBA"}


def heic(pixels: NDArray[Any], turn: int = 1, bits: int = 10, **options: Any) -> bytes:
    """A HEIC of (height, width, 1, 3 or 4) pixels, uint8, or uint16 of 10 or 12 bits; RGB is kept exactly.

    ``turn`` is the orientation that the file states.
    """
    height, width, channels = pixels.shape
    mode = MODES[channels] if pixels.dtype == np.uint8 else f"{MODES[channels]};{bits}"
    exif = Image.Exif()
    exif[274] = turn
    # RGB as it is, for conversion to YCbCr would round.
    options = {"quality": -1, "chroma": 444, "exif": exif.tobytes()} | options
    if channels > 1:
        options.setdefault("matrix_coefficients", 0)
    target = io.BytesIO()
    pillow_heif.encode(mode, (width, height), np.ascontiguousarray(pixels).tobytes(), target, **options)
    return target.getvalue()
