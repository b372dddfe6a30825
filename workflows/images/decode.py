"""Decode a picture of any supported format, for a backdrop."""

import io
from collections.abc import Iterator
from typing import BinaryIO, Literal

import imagecodecs
import numpy as np
from PIL import Image

from storage.errors import ImageError
from workflows.images import camera_raw, float_formats, heif, integer_formats, raw_files, web_formats
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes

Transfer = Literal["srgb", "linear"]
FORMATS = (*integer_formats.FORMATS, *web_formats.FORMATS)
"""What Pillow opens of a backdrop: what browsers show, too."""


def decode(data: bytes, transfer: Transfer, *, memory: int) -> Codes | Floats:
    """Decode a picture.

    Parameters
    ----------
    data : bytes
        PNG, JPEG, WebP, AVIF, GIF, TIFF, HEIC, EXR, Radiance HDR or camera RAW. Of a moving picture the first frame is
        decoded.
    transfer : str
        How integers encode light. Colours with an ICC profile are converted to sRGB, unless this is ``linear``. RAW
        and floats are linear light in any case, and that of an EXR is converted from the primaries that it names.
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
    if raw_files.is_raw(data):
        return camera_raw.develop(data, memory=memory)
    if float_formats.is_float(data):
        return float_formats.in_rec_709(data, float_formats.decode(data, memory=memory))
    pixels = integer_formats.decode(data, memory=memory, alpha=True, formats=FORMATS)
    return _to_srgb(data, pixels) if transfer == "srgb" else pixels


def decode_file(file: BinaryIO, transfer: Transfer, memory: int) -> Iterator[Codes | Floats]:
    """The same for `workflows.untrusted.decoder.Decoder.picture`."""
    yield decode(file.read(), transfer, memory=memory)


def _to_srgb(data: bytes, pixels: Codes) -> Codes:
    """Convert RGB to sRGB by the colour profile of the file, if it has one."""
    profile = heif.profile(data) if heif.is_heif(data) else _profile(data)
    if not profile or pixels.shape[2] < 3:
        return pixels
    colours = np.ascontiguousarray(pixels[..., :3])
    try:
        converted = imagecodecs.cms_transform(
            colours, profile, imagecodecs.cms_profile("srgb"), colorspace="rgb", outcolorspace="rgb"
        )
    except Exception as error:  # damaged bytes raise many kinds of errors
        raise ImageError(
            "the image's colour profile can't be used: save it without one, or as sRGB"
        ) from error
    return np.concatenate([converted, pixels[..., 3:]], axis=2)


def _profile(data: bytes) -> bytes | None:
    """The ICC profile of what Pillow opens."""
    with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
        # Pixels made from a palette or from inks do not have the colours that the profile describes.
        return picture.info.get("icc_profile") if picture.mode in ("RGB", "RGBA", "I;16B", "RGB;16") else None
