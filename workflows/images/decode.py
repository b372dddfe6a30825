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
from workflows.images.tone_curves import from_light

Transfer = Literal["srgb", "linear"]
FORMATS = (*integer_formats.FORMATS, *web_formats.FORMATS)
"""What Pillow opens of a backdrop: what browsers show, too."""
SRGB_GAMMA = 1 / 2.2
"""What a PNG says whose values are sRGB, for those who know only its gAMA."""
MOST_LIGHT = np.float32(np.finfo(np.float16).max)
"""The largest light, of either sign: what pictures of 16-bit floats hold. Sums of much larger values would overflow."""
SAME_GAMMA = 0.05
"""Gammas that differ by this share or less are the same, as libpng has it."""


def decode(data: bytes, transfer: Transfer, *, memory: int) -> Codes | Floats:
    """Decode a picture.

    Parameters
    ----------
    data : bytes
        PNG, JPEG, WebP, AVIF, GIF, TIFF, HEIC, EXR, Radiance HDR or camera RAW. Of a moving picture the first frame is
        decoded.
    transfer : str
        How integers encode light. Colours with an ICC profile, and PNGs of another gamma, are converted to sRGB,
        unless this is ``linear``. RAW and floats are linear light in any case, and that of an EXR is converted from
        the primaries that it names.
    memory : int
        Bytes that the decoded picture may take.

    Returns
    -------
    (height, width, 1 to 4) uint8 or uint16, or (height, width, 1 or 3) float32
        Upright, grey or RGB. Integers keep an alpha channel; float values are linear light within `MOST_LIGHT`, black
        where transparent.

    Raises
    ------
    ImageError
        If it can't be decoded, or a pixel is NaN.
    """
    if raw_files.is_raw(data):
        return camera_raw.develop(data, memory=memory)
    if float_formats.is_float(data):
        light = float_formats.decode(data, memory=memory, alpha=True)
        _check_numbers(light)
        # Before the primaries are converted too: there infinity becomes NaN.
        return _clip(float_formats.in_rec_709(data, _clip(light)))
    pixels = integer_formats.decode(data, memory=memory, alpha=True, formats=FORMATS)
    return _to_srgb(data, pixels) if transfer == "srgb" else pixels


def decode_file(file: BinaryIO, transfer: Transfer, memory: int) -> Iterator[Codes | Floats]:
    """The same for `workflows.untrusted.decoder.Decoder.picture`."""
    yield decode(file.read(), transfer, memory=memory)


def _check_numbers(light: Floats) -> None:
    """Refuse light that is NaN, which would spoil every pixel that sees it."""
    rows, columns = np.nonzero(np.isnan(light).any(axis=2))
    if rows.size:
        raise ImageError(
            f"the image has no number (NaN) in {rows.size} of its pixels, first at x = {columns[0]}, y = {rows[0]}: "
            "replace them, and export it again"
        )


def _clip(light: Floats) -> Floats:
    """Clip light to `MOST_LIGHT`, in place."""
    return np.clip(light, -MOST_LIGHT, MOST_LIGHT, out=light)


def _to_srgb(data: bytes, pixels: Codes) -> Codes:
    """Convert a picture to sRGB by the colour profile of the file, if it has one, or by a PNG's gamma."""
    if heif.is_heif(data):
        profile, gamma = heif.profile(data), None
    else:
        profile, gamma = _profile_and_gamma(data)
    if gamma:
        return _gamma_to_srgb(pixels, gamma)
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


def _gamma_to_srgb(pixels: Codes, gamma: float) -> Codes:
    """Convert values that are light to the power of gamma."""
    top = np.iinfo(pixels.dtype).max
    light = (np.arange(top + 1, dtype=np.float32) / np.float32(top)) ** np.float32(1 / gamma)
    codes = integer_formats.to_integers(from_light(light, "srgb"), pixels.dtype)
    colours = 3 if pixels.shape[2] >= 3 else 1
    return np.concatenate([codes[pixels[..., :colours]], pixels[..., colours:]], axis=2)


def _profile_and_gamma(data: bytes) -> tuple[bytes | None, float | None]:
    """The ICC profile of what Pillow opens, and the gamma of a PNG of which nothing better says what it has."""
    with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
        profile, gamma = picture.info.get("icc_profile"), None
        if picture.format == "PNG" and not profile and "srgb" not in picture.info:
            gamma = picture.info.get("gamma")
        # In the third edition of PNG cICP comes before all others. Pillow does not know it.
        if not gamma or abs(gamma / SRGB_GAMMA - 1) < SAME_GAMMA or b"cICP" in data[: data.find(b"IDAT")]:
            gamma = None
        # Pixels made from a palette or from inks do not have the colours that the profile describes.
        return profile if picture.mode in ("RGB", "RGBA", "I;16B", "RGB;16") else None, gamma
