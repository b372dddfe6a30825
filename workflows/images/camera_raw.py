"""Decode camera RAW to linear light: the sensor's counts, not demosaiced, and for a picture white-balanced."""

import io
from typing import NamedTuple

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.orientation import upright
from workflows.images.raw_files import FILTERED, images
from workflows.untrusted.limits import check_size

JPEG = b"\xff\xd8\xff"
"""First bytes of a JPEG, which no RAW known here begins with."""
FULL = 0.99
"""Values from this share of the sensor's range on count as clipped, because photosites saturate at different values."""
_BLOCKS = {2: 2, 6: 3}  # photosites along a pixel, by the period of the colour filter: Bayer, X-Trans
# Bytes of the decoded image for a pixel of three colours, and for a photosite of four.
_LINEAR, _PHOTOSITE = 12, 3
_TURNS = {3: 3, 5: 8, 6: 6}  # EXIF orientations by LibRaw's flip
SPREAD = 100.0
"""Colours of cameras lie no further apart: a larger number in a matrix, or its condition, is damage."""
_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""CIE XYZ of sRGB's primaries (IEC 61966-2-1)."""


class _Read(NamedTuple):
    """What a RAW file holds.

    Attributes
    ----------
    light : (h, w, 3) float32
        As `decode` returns it, before it is turned upright.
    turn : int
        The orientation that the file states.
    balance : (3,) float64
        By what the camera multiplies red, green and blue, the least of them 1.
    to_srgb : (3, 3) float64
        From balanced colours of the camera to linear sRGB.
    """

    light: NDArray[np.float32]
    turn: int
    balance: NDArray[np.float64]
    to_srgb: NDArray[np.float64]


def orientation(data: bytes) -> int:
    """The orientation of a RAW file for `orientation.upright`; 1, which is no turn, if it can't be read."""
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
        Bytes that the decoded image may take; checked before anything is unpacked. Decoding takes up to three times
        as many.
    turn : int, optional
        Orientation, see `orientation.upright`; by default the file's own.

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
    read = _read(data, memory)
    return upright(read.light, read.turn if turn is None else turn)


def develop(data: bytes, *, memory: int) -> NDArray[np.float32]:
    """Decode camera RAW to a picture to look at, as `decode`, with the camera's white balance and sRGB's primaries.

    Parameters
    ----------
    data : bytes
    memory : int
        As in `decode`.

    Returns
    -------
    (h, w, 3) float32
        Linear light from 0 to 1, upright. 1 is where the sensor clips first, and what is clipped is white. Colours that
        sRGB does not have are clipped, as with other pictures.

    Raises
    ------
    ImageError
        As in `decode`.
    """
    light, turn, balance, to_srgb = _read(data, memory)
    light *= balance.astype(np.float32)
    # Also what is clipped: a highlight in which only green is left is magenta.
    np.minimum(light, 1, out=light)
    for row in light:  # row by row, so that no second picture is in memory
        row[:] = np.clip(row @ to_srgb.T.astype(np.float32), 0, 1)
    return upright(light, turn)


def _read(data: bytes, memory: int) -> _Read:
    try:
        linear = _is_linear(data)
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            width, height = raw.sizes.raw_width, raw.sizes.raw_height
            each, what = (_LINEAR, "linear pixels") if linear else (_PHOTOSITE, "photosites")
            check_size(width, height, each, memory, what)
            raw.unpack()
            if raw.raw_type == rawpy.RawType.Flat:
                light = _superpixels(raw)
            elif linear and raw.num_colors == 3:
                light = _light(raw.raw_image_visible[:, :, :3], raw, [0, 1, 2])
            else:
                raise ImageError(
                    "this RAW image has no colour filter, and is not a linear DNG of three colours: develop it to TIFF "
                    "of 16 bits with a linear curve"
                )
            return _Read(light, _TURNS.get(raw.sizes.flip, 1), _balance(raw), _to_srgb(raw))
    except ImageError:
        raise
    except Exception as error:  # damaged bytes raise many kinds of errors
        raise _refusal(data, error) from error


def _refusal(data: bytes, error: Exception) -> ImageError:
    if data.startswith(JPEG):
        return ImageError(
            "this is a JPEG with the name of camera RAW: rename it to .jpg, or copy the RAW itself"
        )
    if isinstance(error, rawpy.LibRawFileUnsupportedError):
        return ImageError(
            "this camera's RAW format is not supported: convert it to DNG, with lossless compression other than JPEG "
            "XL, or develop it to TIFF of 16 bits with a linear curve"
        )
    return ImageError("the RAW image is cut off or damaged: copy it again from the camera")


def _balance(raw: rawpy.RawPy) -> NDArray[np.float64]:
    """The white balance of the camera, or else of daylight, or else none."""
    for stated in (raw.camera_whitebalance, raw.daylight_whitebalance):
        balance = np.array(stated[:3], np.float64)
        if np.isfinite(balance).all() and balance.min() > 0:
            return np.asarray(balance / balance.min(), np.float64)
    return np.ones(3)


def _to_srgb(raw: rawpy.RawPy) -> NDArray[np.float64]:
    """From balanced colours of the camera to linear sRGB; white stays white.

    Notes
    -----
    A DNG has such a matrix. Of other files LibRaw knows the matrix M from XYZ to the camera: rows of M A, with XYZ of
    the primaries in A, are divided by their sums, so that equal parts of all primaries give equal values, and inverted.
    Without either, or if they are damaged, colours stay as they are.
    """
    stated = np.array(raw.color_matrix[:, :3], np.float64)
    if not stated.any():
        camera = np.array(raw.rgb_xyz_matrix[:3], np.float64) @ _XYZ
        total = camera.sum(axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            camera /= total
        if not np.isfinite(camera).all() or np.linalg.cond(camera) > SPREAD:
            return np.eye(3)
        stated = np.linalg.inv(camera)
    whole = bool(np.isfinite(stated).all()) and float(np.abs(stated).max()) < SPREAD
    return stated if whole else np.eye(3)


def _is_linear(data: bytes) -> bool:
    """Whether bytes are a DNG whose main image has all colours in each pixel.

    Raises
    ------
    ImageError, EOFError
        If it has float values, or is cut off.
    """
    if not data.startswith((b"II*", b"MM\0*")):
        return False
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        for page in images(file.pages[0]):
            if page.subfiletype != 0:  # a preview or a mask
                continue
            if page.sampleformat == tifffile.SAMPLEFORMAT.IEEEFP:
                # LibRaw scales each file by its own largest value: frames would have different units.
                raise ImageError("DNGs of float values are not supported: develop them to EXR or float TIFF")
            ends = (a + b for a, b in zip(page.dataoffsets, page.databytecounts, strict=False))
            if page.photometric in FILTERED and max(ends, default=0) > len(data):
                # LibRaw takes what is missing for zeros.
                raise EOFError(f"an image ends after the {len(data)} bytes of the file")
            if page.photometric == tifffile.PHOTOMETRIC.LINEAR_RAW:
                return True
    return False


def _superpixels(raw: rawpy.RawPy) -> NDArray[np.float32]:
    """The light of an unpacked RAW with a colour filter: the mean of each colour in each block."""
    period = _period(raw)
    if period not in _BLOCKS:
        raise ImageError(
            "this RAW image comes from a sensor with neither a Bayer nor an X-Trans filter: develop it to TIFF of "
            "16 bits with a linear curve"
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
            f"this RAW image has the colours {raw.color_desc!r}: only red, green and blue are supported; "
            "develop it to TIFF of 16 bits with a linear curve"
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


def _period(raw: rawpy.RawPy) -> int:
    """After how many photosites the colour filter repeats; 0 without one, as in a monochrome sensor."""
    return 0 if raw.raw_pattern is None else len(raw.raw_pattern)


def _first_block(colours: NDArray[np.str_]) -> tuple[int, int]:
    """Where a block with green in its middle and corners begins in an X-Trans filter."""
    for y, x in np.ndindex(3, 3):
        block = np.roll(colours, (-y, -x), (0, 1))[:3, :3].ravel()
        if (block[::2] == "G").all():
            return y, x
    raise ImageError(
        "the RAW image is damaged, its colour filter is not that of an X-Trans sensor: copy it again from "
        "the camera"
    )


def _light(values: NDArray[np.uint16], raw: rawpy.RawPy, number: int | list[int]) -> NDArray[np.float32]:
    """Linear light of the counts of one of LibRaw's colours, or of several along the last axis."""
    black = np.array(raw.black_level_per_channel, np.float32)[number]
    span = np.float32(raw.white_level) - black
    if span.min() <= 0:
        raise ImageError(
            f"the RAW image's white level {raw.white_level} is not above its black level {black.max():g}: it is "
            "damaged, copy it again from the camera"
        )
    light = values.astype(np.float32)
    light -= black
    light /= span
    light[light >= FULL] = np.inf
    return light
