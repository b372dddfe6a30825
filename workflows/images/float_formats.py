"""EXR, Radiance HDR and float TIFF to arrays, and EXR back: linear light without an upper limit."""

import io
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import imagecodecs
import numpy as np
import OpenEXR
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.integer_formats import LOSSLESS, PLAIN, check_tiles, has_alpha, orientation
from workflows.images.orientation import upright
from workflows.images.writers.exr import write_exr
from workflows.untrusted import tiff_lzw
from workflows.untrusted.limits import check_size

Floats = NDArray[np.float32]
EXR = b"v/1\x01"
"""The first bytes of an EXR."""
HDR = b"#?"
"""Those of a Radiance HDR."""
REC_709 = np.array([0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290], np.float32)
"""x and y of red, green, blue and white: the attribute ``chromaticities`` of an EXR whose light has these primaries."""
MOST = 100
"""What the conversion of primaries may multiply a channel by: more is no real light's."""
_CONES = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""From XYZ to what adapts to white, by Bradford."""


def is_float(data: bytes) -> bool:
    """Whether bytes are an EXR, a Radiance HDR or a float TIFF, judging by their header."""
    if data.startswith((EXR, HDR)):
        return True
    if not data.startswith((b"II", b"MM")):
        return False
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            return bool(file.pages[0].sampleformat == tifffile.SAMPLEFORMAT.IEEEFP)
    except Exception:  # damaged bytes raise many kinds of errors
        return False


def decode(data: bytes, *, memory: int, turn: int | None = None, alpha: bool = False) -> Floats:
    """Decode an EXR, a Radiance HDR or a float TIFF.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that decoding may take; checked by the header, before anything is decoded.
    turn : int, optional
        Orientation of a TIFF, see `orientation.upright`; by default the file's own. The others have none.
    alpha : bool
        Whether transparent pixels become black, in proportion. An EXR has them so already.

    Returns
    -------
    (height, width, 1 or 3) float32
        Grey or RGB, as stored: values may be large, negative or not finite. Alpha and all other channels are dropped.
        Of an EXR the display window: black where the data window leaves it out, without what lies beyond it.

    Raises
    ------
    ImageError
        If it is damaged, too large, or of an unsupported kind.
    """
    kind = "TIFF"
    read: Callable[[bytes, int], Floats] = partial(_tiff, alpha=alpha)
    if data.startswith(EXR):
        kind, read = "EXR", _exr
    elif data.startswith(HDR):
        kind, read = "HDR", _hdr
    try:
        pixels = read(data, memory)
    except ImageError:
        raise
    except Exception as error:  # as above
        raise ImageError(f"the {kind} image is cut off or damaged: export it again") from error
    if kind != "TIFF":
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
    header = {"chromaticities": REC_709}
    write_exr(file, width, height, dict.fromkeys(channels, np.float32), [planes], header)
    return file.getvalue()


def in_rec_709(data: bytes, pixels: Floats) -> Floats:
    """The decoded light of an EXR or a float TIFF in the primaries of Rec. 709, white as white.

    An EXR says what its primaries are, such as ACEScg's; without ``chromaticities`` they are those of Rec. 709.

    Raises
    ------
    ImageError
        If no light can have its ``chromaticities``.

    Notes
    -----
    ``XYZ = M RGB``, M the primaries' XYZ scaled so that (1, 1, 1) is white of Y = 1 (SMPTE RP 177). Whites are adapted
    by Bradford's matrix.
    """
    if pixels.shape[2] != 3 or not data.startswith(EXR):
        return pixels
    with OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0) as file:
        given = file.header().get("chromaticities")
    if given is None:
        return pixels
    values, matrix = np.asarray(given), np.full((3, 3), np.nan)
    if values.shape == (8,) and values.dtype.kind == "f":
        if np.allclose(values, REC_709, atol=1e-4):
            return pixels
        with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
            matrix = np.linalg.solve(_adapted(REC_709), _adapted(values))
    if not (np.abs(matrix) < MOST).all():
        raise ImageError(
            "no light has the chromaticities of this EXR: export it as linear Rec. 709 or ACEScg"
        )
    return pixels @ matrix.T.astype(np.float32)


def _adapted(chromaticities: NDArray[np.floating]) -> NDArray[np.float64]:
    """From RGB of some primaries to cones that are adapted to their white."""
    x, y = chromaticities.astype(np.float64).reshape(4, 2).T
    primaries = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    to_xyz = primaries[:, :3] * np.linalg.solve(primaries[:, :3], primaries[:, 3])
    return np.asarray(_CONES @ to_xyz / (_CONES @ primaries[:, 3])[:, np.newaxis])


def _exr(data: bytes, memory: int) -> Floats:
    # With 0 threads, OpenEXR works in the calling thread, like everything else in a worker.
    with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True, num_threads=0) as file:
        if len(file.parts) != 1 or file.parts[0].type() not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise ImageError("this EXR has several parts, or is deep: export it as a single flat image")
        header = file.header()
        channels = {channel.name: channel for channel in header["channels"]}
        tiles = header.get("tiles")
        data_low, data_high = (corner.astype(np.int64) for corner in header["dataWindow"])
        low, high = (corner.astype(np.int64) for corner in header["displayWindow"])
    names = ["R", "G", "B"] if {"R", "G", "B"} <= channels.keys() else ["Y"]
    if not channels.keys() >= set(names):
        raise ImageError(f"this EXR has the channels {', '.join(channels)}: R, G and B, or Y are needed")
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels.values()):
        raise ImageError("this EXR has subsampled channels: export it as RGB")
    width, height = (high - low + 1).tolist()
    if width < 1 or height < 1:
        raise ImageError("the display window of this EXR is empty: export it again")
    # All channels of the data window are decoded, at up to 4 bytes a value, before those that are needed are copied.
    across, down = np.maximum(high - low, data_high - data_low).tolist()
    check_size(across + 1, down + 1, 4 * (len(channels) + len(names)), memory, "float pixels")
    if tiles is not None:  # which the library decodes whole, however little of one the image fills
        check_size(tiles.xSize, tiles.ySize, 4 * len(channels), memory, "float pixels")
    with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
        planes = file.channels()
        pixels = np.zeros((height, width, len(names)), np.float32)
        # Where the windows overlap; both corners are (x, y).
        first = np.maximum(low, data_low)
        end = np.maximum(np.minimum(high, data_high) + 1, first)
        columns, rows = map(slice, first - low, end - low)
        stored_columns, stored_rows = map(slice, first - data_low, end - data_low)
        for c, name in enumerate(names):
            pixels[rows, columns, c] = planes[name].pixels[stored_rows, stored_columns]
    return pixels


def _hdr(data: bytes, memory: int) -> Floats:
    """Three values with one exponent (Ward, "Real pixels", Graphics Gems II, 1991)."""
    header, _, rest = data.partition(b"\n\n")
    size = re.match(rb"-Y (\d{1,9}) \+X (\d{1,9})\n", rest)
    if b"\nFORMAT=32-bit_rle_rgbe" not in header or size is None:
        raise ImageError("this HDR image is no upright RGB: export it as EXR")
    height, width = map(int, size.groups())
    check_size(width, height, 16, memory, "float pixels")
    pixels = np.empty((height, width, 3), np.float32)
    imagecodecs.rgbe_decode(rest[size.end() :], header=False, rle=True, out=pixels)
    return pixels


def _tiff(data: bytes, memory: int, alpha: bool) -> Floats:
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
        alpha = alpha and has_alpha(page)
        check_size(width, height, stored + 4 * (channels + alpha), memory, "float pixels")
        tiff_lzw.check_lzw(data, page)
        array = np.asarray(page.asarray())
        if array.size != height * width * page.samplesperpixel:
            raise ImageError("the TIFF image is damaged, its tags contradict each other: export it again")
        if page.axes == "SYX":
            array = np.moveaxis(array, 0, -1)
        array = array.reshape(height, width, -1)
        light = np.array(array[:, :, :channels], np.float32, order="C")
        if alpha:
            light *= np.clip(array[:, :, channels : channels + 1], 0, 1)
        return light
