"""Images of float values to arrays: EXR and float TIFF, which hold linear light without an upper end."""

import io
from typing import Any

import numpy as np
import OpenEXR
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.integer_formats import LOSSLESS, PLAIN, orientation, see_that_tiles_fit, upright
from workflows.untrusted import tiff_lzw

Floats = NDArray[np.float32]
EXR = b"v/1\x01"
"""What an EXR begins with."""


def is_float(data: bytes) -> bool:
    """Whether bytes are, by their header, an EXR or a TIFF of float values."""
    if data.startswith(EXR):
        return True
    if not data.startswith((b"II", b"MM")):
        return False
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            return bool(file.pages[0].sampleformat == tifffile.SAMPLEFORMAT.IEEEFP)
    except Exception:  # what a parser raises on damaged bytes is not a closed set
        return False


def decode(data: bytes, *, memory: int, turn: int | None = None) -> Floats:
    """Decode an EXR or a float TIFF.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that decoding may take; checked in the header, before anything is decoded.
    turn : int, optional
        How a TIFF is turned, see `images.upright`; default as it says itself. An EXR never is.

    Returns
    -------
    (height, width, 1 or 3) float32
        Grey or RGB, as stored: of any size, negative or not finite. An alpha channel, and whatever else an EXR
        has beside R, G and B or Y, is dropped.

    Raises
    ------
    ImageError
        If it is damaged, too large, or of a kind that is not read.
    """
    kind, read = ("EXR", _exr) if data.startswith(EXR) else ("TIFF", _tiff)
    try:
        pixels = read(data, memory)
    except ImageError:
        raise
    except Exception as error:  # as above
        raise ImageError(f"the {kind} image is cut off or damaged: {error}") from error
    if kind == "EXR":
        return pixels
    return upright(pixels, orientation(data) if turn is None else turn)


def encode_exr(channels: dict[str, NDArray[Any]], header: dict[str, Any] | None = None) -> bytes:
    """An EXR of float channels, compressed without loss.

    Parameters
    ----------
    channels : dict of str to (height, width) or (height, width, 3 or 4) float16 or float32
        By name, as ``alpha`` or ``RGB``.
    header : dict, optional
        More attributes.
    """
    file = io.BytesIO()
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | (header or {})
    with OpenEXR.File(attributes, {name: np.ascontiguousarray(v) for name, v in channels.items()}) as image:
        image.write(file)
    return file.getvalue()


def _exr(data: bytes, memory: int) -> Floats:
    # 0 threads: the work is done in the one that asks, as everywhere in a worker.
    with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True, num_threads=0) as file:
        if len(file.parts) != 1 or file.parts[0].type() not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise ImageError("EXR images are read with one part, flat and not deep: export it so")
        header = file.header()
        channels = {channel.name: channel for channel in header["channels"]}
        tiles = header.get("tiles")
        low, high = (corner.astype(np.int64) for corner in header["dataWindow"])
    names = ["R", "G", "B"] if {"R", "G", "B"} <= channels.keys() else ["Y"]
    if not channels.keys() >= set(names):
        raise ImageError(
            f"EXR images are read with channels R, G and B, or Y; this one has {', '.join(channels)}"
        )
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels.values()):
        raise ImageError("EXR images are not read with subsampled channels: export it as RGB")
    width, height = (high - low + 1).tolist()
    # All channels are decoded, with 4 bytes a value at most, before the wanted ones are copied.
    _see_that_it_fits(width, height, 4 * (len(channels) + len(names)), memory)
    if tiles is not None:  # which the library decodes whole, however little of one the image fills
        _see_that_it_fits(tiles.xSize, tiles.ySize, 4 * len(channels), memory)
    with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
        planes = file.channels()
        pixels = np.empty((height, width, len(names)), np.float32)
        for c, name in enumerate(names):
            pixels[:, :, c] = planes[name].pixels
    return pixels


def _tiff(data: bytes, memory: int) -> Floats:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages[0]
        see_that_tiles_fit(page, memory)
        if page.compression not in LOSSLESS or page.photometric not in PLAIN - {
            tifffile.PHOTOMETRIC.MINISWHITE
        }:
            raise ImageError("float TIFF images are read as grey or RGB, uncompressed or deflated")
        if page.axes not in ("YX", "YXS", "SYX") or not 1 <= page.samplesperpixel <= 4:
            raise ImageError(f"float TIFF images are read as grey or RGB; this one has the axes {page.axes}")
        height, width = page.imagelength, page.imagewidth
        stored = -(-page.nbytes // (width * height))
        channels = 3 if page.samplesperpixel > 2 else 1
        _see_that_it_fits(width, height, stored + 4 * channels, memory)
        tiff_lzw.see_that_it_is_sound(data, page)
        array = np.asarray(page.asarray())
        if array.size != height * width * page.samplesperpixel:
            raise ImageError("the TIFF image is cut off or damaged: its tags contradict each other")
        if page.axes == "SYX":
            array = np.moveaxis(array, 0, -1)
        return np.ascontiguousarray(array.reshape(height, width, -1)[:, :, :channels], np.float32)


def _see_that_it_fits(width: int, height: int, pixel: int, memory: int) -> None:
    if width * height * pixel > memory:
        raise ImageError(
            f"decoding an image of {width} x {height} float pixels takes more than the {memory} bytes allowed for one",
            limit=memory,
        )
