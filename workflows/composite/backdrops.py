"""Files of pictures to the light of a backdrop."""

import io
from typing import Literal

import imagecodecs
import numpy as np
from PIL import Image

from storage.errors import ImageError
from workflows import floats, images
from workflows.composite.light import Backdrop
from workflows.images import Codes
from workflows.tone import table


def read_backdrop(data: bytes, transfer: Literal["srgb", "linear"], *, memory: int) -> Backdrop:
    """Decode a backdrop.

    Parameters
    ----------
    data : bytes
        PNG, JPEG, TIFF or EXR.
    transfer : str
        How integers encode light; float values are linear light.
    memory : int
        Bytes that the decoded image may take.

    Returns
    -------
    Backdrop
        Where it is transparent it is black, in part in proportion: there is no light behind it. A profile (ICC) that
        goes with it is converted to sRGB's, unless its values are linear light. What is infinite or no number in a
        float image is black.

    Raises
    ------
    ImageError
    """
    if floats.is_float(data):
        light = floats.decode(data, memory=memory)
        return Backdrop(np.nan_to_num(light, copy=False, nan=0, posinf=0, neginf=0))
    pixels = images.decode(data, memory=memory, alpha=True)
    if transfer == "srgb":
        pixels = _in_srgb(data, pixels)
    light_of = table(transfer, pixels.dtype)
    if pixels.shape[2] in (1, 3):
        return Backdrop(pixels, light_of)
    colours, alpha = pixels[..., :-1], pixels[..., -1:]
    top = np.iinfo(pixels.dtype).max
    if (alpha == top).all():
        return Backdrop(colours, light_of)
    return Backdrop(light_of.take(colours) * images.to_unit(alpha))


def _in_srgb(data: bytes, pixels: Codes) -> Codes:
    """RGB in sRGB's colours, by the profile of the file that it comes from."""
    with Image.open(io.BytesIO(data), formats=images.READ) as picture:
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
