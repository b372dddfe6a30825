"""Decode a picture of any supported format, for a backdrop."""

import io
from typing import Literal

import imagecodecs
import numpy as np
from PIL import Image

from storage.errors import ImageError
from workflows.images import float_formats, integer_formats
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes

Transfer = Literal["srgb", "linear"]


def decode(data: bytes, transfer: Transfer, *, memory: int) -> Codes | Floats:
    """Decode a picture.

    Parameters
    ----------
    data : bytes
        PNG, JPEG, TIFF or EXR.
    transfer : str
        How integers encode light. Colours with an ICC profile are converted to sRGB, unless this is ``linear``.
    memory : int
        Bytes that the decoded picture may take.

    Returns
    -------
    (height, width, 1 to 4) uint8 or uint16, or (height, width, 1 or 3) float32
        Upright, grey or RGB. Integers keep an alpha channel; float values are linear light without one.

    Raises
    ------
    ImageError
    """
    if float_formats.is_float(data):
        return float_formats.decode(data, memory=memory)
    pixels = integer_formats.decode(data, memory=memory, alpha=True)
    return _to_srgb(data, pixels) if transfer == "srgb" else pixels


def _to_srgb(data: bytes, pixels: Codes) -> Codes:
    """Convert RGB to sRGB by the ICC profile of the file, if it has one."""
    with Image.open(io.BytesIO(data), formats=integer_formats.FORMATS) as picture:
        profile = picture.info.get("icc_profile")
        # Pixels made from a palette or from inks do not have the colours that the profile describes.
        if not profile or picture.mode not in ("RGB", "RGBA", "I;16B", "RGB;16"):
            return pixels
    if pixels.shape[2] < 3:
        return pixels
    colours = np.ascontiguousarray(pixels[..., :3])
    try:
        converted = imagecodecs.cms_transform(
            colours, profile, imagecodecs.cms_profile("srgb"), colorspace="rgb", outcolorspace="rgb"
        )
    except Exception as error:  # damaged bytes raise many kinds of errors
        raise ImageError(f"the image's colour profile can't be used: {error}; save it without one") from error
    return np.concatenate([converted, pixels[..., 3:]], axis=2)
