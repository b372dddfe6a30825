"""EXR and float TIFF to arrays and back: linear light without an upper limit."""

import io

import numpy as np
import OpenEXR
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.exr_writer import write_exr
from workflows.images.integer_formats import LOSSLESS, PLAIN, check_tiles, orientation
from workflows.images.orientation import upright
from workflows.untrusted import tiff_lzw
from workflows.untrusted.limits import check_size

Floats = NDArray[np.float32]
EXR = b"v/1\x01"
"""The first bytes of an EXR."""


def is_float(data: bytes) -> bool:
    """Whether bytes are an EXR or a float TIFF, judging by their header."""
    if data.startswith(EXR):
        return True
    if not data.startswith((b"II", b"MM")):
        return False
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            return bool(file.pages[0].sampleformat == tifffile.SAMPLEFORMAT.IEEEFP)
    except Exception:  # damaged bytes raise many kinds of errors
        return False


def decode(data: bytes, *, memory: int, turn: int | None = None) -> Floats:
    """Decode an EXR or a float TIFF.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that decoding may take; checked by the header, before anything is decoded.
    turn : int, optional
        Orientation of a TIFF, see `orientation.upright`; by default the file's own. An EXR has none.

    Returns
    -------
    (height, width, 1 or 3) float32
        Grey or RGB, as stored: values may be large, negative or not finite. Alpha and all other channels are dropped.

    Raises
    ------
    ImageError
        If it is damaged, too large, or of an unsupported kind.
    """
    kind, read = ("EXR", _exr) if data.startswith(EXR) else ("TIFF", _tiff)
    try:
        pixels = read(data, memory)
    except ImageError:
        raise
    except Exception as error:  # as above
        raise ImageError(f"the {kind} image is cut off or damaged: export it again") from error
    if kind == "EXR":
        return pixels
    return upright(pixels, orientation(data) if turn is None else turn)


def encode_exr(channels: str, pixels: Floats) -> bytes:
    """Encode a picture as EXR of 32 bits with lossless compression.

    Parameters
    ----------
    channels : str
        Their names, such as ``RGB``.
    pixels : (height, width, channels) float32
    """
    file = io.BytesIO()
    height, width, _ = pixels.shape
    planes = {name: pixels[..., c] for c, name in enumerate(channels)}
    write_exr(file, width, height, dict.fromkeys(channels, np.float32), [planes])
    return file.getvalue()


def _exr(data: bytes, memory: int) -> Floats:
    # With 0 threads, OpenEXR works in the calling thread, like everything else in a worker.
    with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True, num_threads=0) as file:
        if len(file.parts) != 1 or file.parts[0].type() not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise ImageError("this EXR has several parts, or is deep: export it as a single flat image")
        header = file.header()
        channels = {channel.name: channel for channel in header["channels"]}
        tiles = header.get("tiles")
        low, high = (corner.astype(np.int64) for corner in header["dataWindow"])
    names = ["R", "G", "B"] if {"R", "G", "B"} <= channels.keys() else ["Y"]
    if not channels.keys() >= set(names):
        raise ImageError(f"this EXR has the channels {', '.join(channels)}: R, G and B, or Y are needed")
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels.values()):
        raise ImageError("this EXR has subsampled channels: export it as RGB")
    width, height = (high - low + 1).tolist()
    # All channels are decoded, at up to 4 bytes a value, before those that are needed are copied.
    check_size(width, height, 4 * (len(channels) + len(names)), memory, "float pixels")
    if tiles is not None:  # which the library decodes whole, however little of one the image fills
        check_size(tiles.xSize, tiles.ySize, 4 * len(channels), memory, "float pixels")
    with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
        planes = file.channels()
        pixels = np.empty((height, width, len(names)), np.float32)
        for c, name in enumerate(names):
            pixels[:, :, c] = planes[name].pixels
    return pixels


def _tiff(data: bytes, memory: int) -> Floats:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages[0]
        check_tiles(page, memory)
        if page.compression not in LOSSLESS or page.photometric not in PLAIN - {
            tifffile.PHOTOMETRIC.MINISWHITE
        }:
            raise ImageError("this float TIFF is not supported: use grey or RGB, uncompressed or deflated")
        if page.axes not in ("YX", "YXS", "SYX") or not 1 <= page.samplesperpixel <= 4:
            raise ImageError(f"this float TIFF has the axes {page.axes}: only grey and RGB are supported")
        height, width = page.imagelength, page.imagewidth
        stored = -(-page.nbytes // (width * height))
        channels = 3 if page.samplesperpixel > 2 else 1
        check_size(width, height, stored + 4 * channels, memory, "float pixels")
        tiff_lzw.check_lzw(data, page)
        array = np.asarray(page.asarray())
        if array.size != height * width * page.samplesperpixel:
            raise ImageError("the TIFF image is damaged, its tags contradict each other: export it again")
        if page.axes == "SYX":
            array = np.moveaxis(array, 0, -1)
        return np.ascontiguousarray(array.reshape(height, width, -1)[:, :, :channels], np.float32)
