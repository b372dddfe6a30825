"""Decode camera RAW to linear light: the sensor's counts, without demosaicing, white balance or curve."""

import io
from itertools import islice
from pathlib import PurePosixPath

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.integer_formats import upright

SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
"""Extensions of RAW files. By their bytes, many of them are TIFFs that begin with a thumbnail."""
FULL = 0.99
"""Values from this share of the sensor's range on count as clipped, because photosites saturate at different values."""
_BLOCKS = {2: 2, 6: 3}  # photosites along a pixel, by the period of the colour filter: Bayer, X-Trans
_PHOTOSITE, _LINEAR = (
    2 + 4,
    8 + 12 + 4,
)  # bytes that decoding takes for a photosite, and for a pixel of three colours
_TURNS = {3: 3, 5: 8, 6: 6}  # EXIF orientations by LibRaw's flip
_IMAGES = 16  # images of a DNG that are examined


def is_raw(name: str) -> bool:
    """Whether a file is camera RAW, judging by its name."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def orientation(data: bytes) -> int:
    """The orientation of a RAW file for `integer_formats.upright`; 1, which is no turn, if it can't be read."""
    try:
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            return _TURNS.get(raw.sizes.flip, 1)
    except Exception:  # see `decode`
        return 1


def decode(data: bytes, *, memory: int, turn: int | None = None) -> NDArray[np.float32]:
    """Decode camera RAW of a Bayer or X-Trans sensor, or a DNG that is demosaiced already.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that decoding may take; checked before anything is unpacked.
    turn : int, optional
        Orientation, see `integer_formats.upright`; by default the file's own.

    Returns
    -------
    (h, w, 3) float32
        Linear light, 0 at the black level and 1 at the white level, without white balance, colour matrix or curve.
        Noise can be negative; clipped values are infinite.

    Raises
    ------
    ImageError
        If LibRaw does not know the camera, the file is damaged, or the sensor has another colour filter.

    Notes
    -----
    Nothing is interpolated: a pixel of a matte holds what it saw, not what its neighbours saw.

    - *Bayer*: half the sensor's width and height. Each square of four photosites is a pixel; its two greens are
      averaged.
    - *X-Trans* (Fuji): a third of the sensor's width and height. The 6 x 6 filter consists of 3 x 3 blocks with green
      in the middle and in the corners, and two reds and two blues between them. Each block is a pixel; its colours
      share a centre. Up to two rows and columns at the edges are cut off.
    - *Linear DNG* (ProRAW of phones, "linear" in Adobe's converter): the size of the file.
    """
    try:
        linear = _is_linear(data)
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            width, height = raw.sizes.raw_width, raw.sizes.raw_height
            each, what = (_LINEAR, "linear pixels") if linear else (_PHOTOSITE, "photosites")
            if width * height * each > memory:
                raise ImageError(
                    f"decoding a RAW image of {width} x {height} {what} takes more than the {memory} bytes allowed "
                    "for one",
                    limit=memory,
                )
            raw.unpack()
            if raw.raw_type == rawpy.RawType.Flat:
                light = _superpixels(raw)
            elif linear and raw.num_colors == 3:
                light = _light(raw.raw_image_visible[:, :, :3], raw, [0, 1, 2])
            else:
                raise ImageError(
                    "this RAW image has no colour filter, and is not a linear DNG of three colours: develop these "
                    "frames to TIFF of 16 bits with a linear curve"
                )
            return upright(light, _TURNS.get(raw.sizes.flip, 1) if turn is None else turn)
    except rawpy.LibRawFileUnsupportedError as error:
        raise ImageError(
            "this camera's RAW format is not supported: convert the frames to DNG, with lossless compression other "
            "than JPEG XL, or develop them to TIFF of 16 bits with a linear curve"
        ) from error
    except ImageError:
        raise
    except Exception as error:  # damaged bytes raise many kinds of errors
        raise ImageError(f"the RAW image is cut off or damaged: {error}") from error


def _is_linear(data: bytes) -> bool:
    """Whether bytes are a DNG whose main image has all colours in each pixel."""
    if not data.startswith((b"II*", b"MM\0*")):
        return False
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        first = file.pages[0]
        for page in (first, *islice(first.pages or (), _IMAGES)):
            if page.subfiletype != 0:  # a preview or a mask
                continue
            if page.sampleformat == tifffile.SAMPLEFORMAT.IEEEFP:
                # LibRaw scales each file by its own largest value: frames would have different units.
                raise ImageError(
                    "DNGs of float values are not supported: develop these frames to EXR or float TIFF"
                )
            if page.photometric == tifffile.PHOTOMETRIC.LINEAR_RAW:
                return True
    return False


def _superpixels(raw: rawpy.RawPy) -> NDArray[np.float32]:
    """The light of an unpacked RAW with a colour filter: the mean of each colour in each block."""
    period = len(raw.raw_pattern)
    if period not in _BLOCKS:
        raise ImageError(
            "this RAW image comes from a sensor with neither a Bayer nor an X-Trans filter: develop these frames to "
            "TIFF of 16 bits with a linear curve"
        )
    block = _BLOCKS[period]
    # `raw_pattern` itself begins in the margin, where LibRaw does not know X-Trans.
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    at = range(period)
    numbers = np.array([[raw.raw_color(top + y, left + x) for x in at] for y in at])
    colours = np.array([*raw.color_desc.decode("latin-1")])[numbers]
    values = raw.raw_image_visible
    if block == 3:
        y, x = _first_block(colours)
        values = values[y:, x:]
        numbers, colours = (np.roll(p, (-y, -x), (0, 1)) for p in (numbers, colours))
    if sorted({*colours[:block, :block].ravel()}) != ["B", "G", "R"]:
        raise ImageError(
            f"this RAW image has the colours {raw.color_desc!r}: only red, green and blue are supported"
        )
    height, width = values.shape[0] // block, values.shape[1] // block
    values = values[: block * height, : block * width]
    pixels = np.zeros((height, width, 3), np.float32)
    step = period // block
    for y, x in np.ndindex(period, period):
        row, column = y // block, x // block
        whole = colours[block * row : block * (row + 1), block * column : block * (column + 1)]
        light = _light(values[y::period, x::period], raw, int(numbers[y, x]))
        light /= np.float32(np.count_nonzero(whole == colours[y, x]))
        pixels[row::step, column::step, "RGB".index(colours[y, x])] += light
    return pixels


def _first_block(colours: NDArray[np.str_]) -> tuple[int, int]:
    """Where a block with green in its middle and corners begins in an X-Trans filter."""
    for y, x in np.ndindex(3, 3):
        block = np.roll(colours, (-y, -x), (0, 1))[:3, :3].ravel()
        if (block[::2] == "G").all():
            return y, x
    raise ImageError("the RAW image is damaged: its colour filter is not that of an X-Trans sensor")


def _light(values: NDArray[np.uint16], raw: rawpy.RawPy, number: int | list[int]) -> NDArray[np.float32]:
    """Linear light of the counts of one of LibRaw's colours, or of several along the last axis."""
    black = np.array(raw.black_level_per_channel, np.float32)[number]
    span = np.float32(raw.white_level) - black
    if span.min() <= 0:
        raise ImageError(
            f"the RAW image's white level {raw.white_level} is not above its black level {black.max():g}"
        )
    light = values.astype(np.float32)
    light -= black
    light /= span
    light[light >= FULL] = np.inf
    return light
