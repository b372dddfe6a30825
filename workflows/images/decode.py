"""Files of pictures to pixels, whatever kind they are: all that decoders of others do for a backdrop."""

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
        How integers encode light. A profile (ICC) that goes with them is converted to sRGB's, unless they are
        ``linear``.
    memory : int
        Bytes that the decoded picture may take.

    Returns
    -------
    (height, width, 1 to 4) uint8 or uint16, or (height, width, 1 or 3) float32
        Upright. Grey or RGB; integers with the alpha channel that is there. Float values are linear light.

    Raises
    ------
    ImageError
    """
    if float_formats.is_float(data):
        return float_formats.decode(data, memory=memory)
    pixels = integer_formats.decode(data, memory=memory, alpha=True)
    return _in_srgb(data, pixels) if transfer == "srgb" else pixels


def _in_srgb(data: bytes, pixels: Codes) -> Codes:
    """RGB in sRGB's colours, by the profile of the file that it comes from."""
    with Image.open(io.BytesIO(data), formats=integer_formats.READ) as picture:
        profile = picture.info.get("icc_profile")
        # The profile of a palette or of inks is not that of what was made of them.
        if not profile or picture.mode not in ("RGB", "RGBA", "I;16B", "RGB;16"):
            return pixels
    if pixels.shape[2] < 3:
        return pixels
    colours = np.ascontiguousarray(pixels[..., :3])
    try:
        converted = imagecodecs.cms_transform(
            colours, profile, imagecodecs.cms_profile("srgb"), colorspace="rgb", outcolorspace="rgb"
        )
    except Exception as error:  # what a library raises on damaged bytes is not a closed set
        raise ImageError(f"the image's colour profile can't be used: {error}; save it without one") from error
    return np.concatenate([converted, pixels[..., 3:]], axis=2)
