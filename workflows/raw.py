"""Camera RAW to linear light, by LibRaw: what the sensor counted, and nothing made of it."""

import io
from pathlib import PurePosixPath

import numpy as np
import rawpy
from numpy.typing import NDArray

from storage.errors import ImageError

SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
"""Of RAW files' names: by their bytes, many are TIFFs that begin with a thumbnail."""
FULL = 0.99
"""Share of the sensor's range from which it counts as clipped: its elements do not end at one value."""


def is_raw(name: str) -> bool:
    """Whether a file is camera RAW, by its name."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def decode(data: bytes, *, memory: int) -> NDArray[np.float32]:
    """Decode camera RAW of a Bayer sensor at half its size.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that decoding may take; checked before anything is unpacked.

    Returns
    -------
    (height // 2, width // 2, 3) float32
        Linear light, 0 at the black level and 1 at the white level: a square of the colour filter's four elements is a
        pixel, the mean of its two greens one channel. No white balance, no matrix, no curve. Noise
        makes negative values; what is clipped is infinite.

    Raises
    ------
    ImageError
        If LibRaw does not know the camera, the file is damaged, or its sensor has another colour filter.
    """
    try:
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            sizes = raw.sizes
            # The sensor's values, and half a pixel in three float32 channels and one being made.
            if sizes.raw_width * sizes.raw_height * (2 + 4) > memory:
                raise ImageError(
                    f"decoding a RAW image of {sizes.raw_width} x {sizes.raw_height} elements takes more than the "
                    f"{memory} bytes allowed for one",
                    limit=memory,
                )
            raw.unpack()
            return _light(raw)
    except rawpy.LibRawFileUnsupportedError as error:
        raise ImageError(
            "this camera's RAW format is not known here: convert the frames to DNG, or develop them to TIFF "
            "of 16 bits with a linear curve"
        ) from error
    except ImageError:
        raise
    except Exception as error:  # what LibRaw's wrapper raises on damaged bytes is not a closed set
        raise ImageError(f"the RAW image is cut off or damaged: {error}") from error


def _light(raw: rawpy.RawPy) -> NDArray[np.float32]:
    """The light of an unpacked RAW."""
    pattern = raw.raw_pattern
    colours = bytes(raw.color_desc)
    if raw.raw_type != rawpy.RawType.Flat or pattern is None or pattern.shape != (2, 2):
        raise ImageError(
            "RAW images are read from sensors with a Bayer filter; develop these frames to TIFF of 16 bits with a "
            "linear curve"
        )
    of_element = [colours[i : i + 1] for i in pattern.ravel().tolist()]
    if sorted(of_element) != [b"B", b"G", b"G", b"R"]:
        raise ImageError(f"RAW images are read from sensors that see red, green and blue, not {colours!r}")
    values = raw.raw_image_visible
    height, width = values.shape[0] // 2, values.shape[1] // 2
    pixels = np.zeros((height, width, 3), np.float32)
    for at, colour in enumerate(of_element):
        black = raw.black_level_per_channel[int(pattern.ravel()[at])]
        span = raw.white_level - black
        if span <= 0:
            raise ImageError(
                f"the RAW image's white level {raw.white_level} is not above its black level {black}"
            )
        counted = values[at // 2 : 2 * height : 2, at % 2 : 2 * width : 2]
        light = (counted.astype(np.float32) - np.float32(black)) / np.float32(span)
        light[light >= FULL] = np.inf
        pixels[:, :, b"RGB".index(colour)] += light / 2 if colour == b"G" else light
    return pixels
