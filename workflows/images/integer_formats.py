"""Image files to arrays and back: PNG, TIFF and JPEG, whoever made them."""

import io
import warnings
from typing import TypeVar, cast

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from storage.errors import ImageError
from workflows.untrusted import tiff_lzw

T = TypeVar("T", bound=np.generic)
Codes = NDArray[np.unsignedinteger]
"""Values as a file stores them: uint8 or uint16."""
READ = ("PNG", "TIFF", "JPEG")
ORIENTATION = 274
"""The tag of EXIF that says how a picture is to be turned."""
LOSSLESS = {
    tifffile.COMPRESSION.NONE,
    tifffile.COMPRESSION.LZW,
    tifffile.COMPRESSION.ADOBE_DEFLATE,
    tifffile.COMPRESSION.DEFLATE,
    tifffile.COMPRESSION.PACKBITS,
    tifffile.COMPRESSION.LZMA,
    tifffile.COMPRESSION.ZSTD,
}
"""Compressions of TIFF that tifffile undoes within the size that the header gives."""
PLAIN = {tifffile.PHOTOMETRIC.MINISWHITE, tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB}
"""What the values of a TIFF mean, where they can be taken as they are."""


START_OF_SCAN = b"\xff\xda"
SCANS = 100
"""Of a JPEG: each costs the time of a picture, and of some bytes one can be made. Encoders write some ten."""


def orientation(data: bytes) -> int:
    """How an image is to be turned to be upright, by its EXIF tag: 1, not at all, to 8, as `upright` takes it.

    1 too if it does not say, or can't be read.
    """
    try:
        if data.startswith((b"II", b"MM")):  # Pillow does not open them all
            with tifffile.TiffFile(io.BytesIO(data)) as file:
                found: int = file.pages[0].tags.valueof(ORIENTATION)
        else:
            with Image.open(io.BytesIO(data), formats=READ) as picture:
                return _said_by(picture)
    except Exception:  # what a parser raises on damaged bytes is not a closed set
        return 1
    return int(found) if found in range(1, 9) else 1


def upright(pixels: NDArray[T], turn: int) -> NDArray[T]:
    """Pixels turned as an orientation says.

    Parameters
    ----------
    pixels : (h, w, ...)
    turn : int
        Of EXIF, tag 274 (CIPA DC-008, sect. 4.6.5): what row and column 0 of the pixels are in the picture. 1: top and
        left, 2: top, right, 3: bottom, right, 4: bottom, left; 5 to 8 the same, of which the row comes second.

    Returns
    -------
    (h, w, ...) or (w, h, ...)
        In C order.
    """
    if turn > 4:
        pixels = pixels.swapaxes(0, 1)
    down, across = turn in (3, 4, 7, 8), turn in (2, 3, 6, 7)
    return np.ascontiguousarray(pixels[:: -1 if down else 1, :: -1 if across else 1])


def decode(
    data: bytes,
    *,
    memory: int,
    formats: tuple[str, ...] = READ,
    alpha: bool = False,
    turn: int | None = None,
) -> Codes:
    """Decode an image.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that the decoded image may take; checked in the header, before anything is decoded.
    formats : tuple of str
        What is taken, out of `READ`.
    alpha : bool
        Whether an alpha channel is kept.
    turn : int, optional
        How it is turned, see `upright`; default as it says itself, `orientation`.

    Returns
    -------
    (height, width, 1 or 3) uint8 or uint16
        Upright. Grey or RGB, a palette looked up; with alpha where that is kept and there, which a palette's is not.

    Raises
    ------
    ImageError
        If it is none of the formats, is damaged, too large, or has values of another type or another number
        of channels.
    """
    try:
        with warnings.catch_warnings():
            # Pillow warns of sizes that it finds suspicious; ours is the limit that counts, below.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(io.BytesIO(data), formats=formats)
    except Image.DecompressionBombError as error:
        raise ImageError(f"the image is too large: {error}", limit=memory) from error
    except Exception as error:  # what a decoder raises on damaged bytes is not a closed set
        raise ImageError(f"this is no {' or '.join(formats)} image that can be read") from error
    if picture.format == "PNG" and getattr(picture, "is_animated", False):
        raise ImageError("this PNG is animated: one picture a file")
    if picture.format in ("JPEG", "MPO") and data.count(START_OF_SCAN) > SCANS:
        raise ImageError(f"this JPEG has more than {SCANS} scans: save it anew", limit=SCANS)
    own = _said_by(picture)  # before it is decoded, which takes it from a TIFF
    try:
        pixels = _pixels(data, picture, memory)
    except ImageError:
        raise
    except Exception as error:
        raise ImageError(f"the {picture.format} image is cut off or damaged: {error}") from error
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim != 3 or pixels.shape[2] not in (1, 2, 3, 4):
        raise ImageError(
            f"{picture.format} images are read as grey or RGB with 8 or 16 bits a channel; "
            f"this one has {pixels.dtype} values in the shape {pixels.shape}"
        )
    codes = cast("Codes", pixels if alpha else pixels[:, :, : 3 if pixels.shape[2] > 2 else 1])
    return upright(codes, own if turn is None else turn)


def _said_by(picture: Image.Image) -> int:
    """The orientation that an image says, none of which is decoded."""
    # Of a PNG Pillow would decode the pixels, to look behind them.
    if picture.format == "PNG" and "exif" not in picture.info:
        return 1
    try:
        found: int = picture.getexif().get(ORIENTATION, 1)
    except Exception:  # as above
        return 1
    return int(found) if found in range(1, 9) else 1


def _pixels(data: bytes, picture: Image.Image, memory: int) -> NDArray[np.generic]:
    if picture.format == "TIFF":
        array = _tiff(data, picture, memory)
    elif picture.format == "PNG" and data[24] == 16:  # the bit depth in IHDR (PNG, sect. 11.2.1)
        _see_that_it_fits(picture, 2 * len(picture.getbands()), memory)
        array = imagecodecs.png_decode(data)  # Pillow would halve the bits
    else:
        array = _by_pillow(picture, memory)
    return array if array.ndim == 3 else array[..., np.newaxis]


def _tiff(data: bytes, picture: Image.Image, memory: int) -> NDArray[np.generic]:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages[0]
        see_that_tiles_fit(page, memory)
        if page.compression not in LOSSLESS or page.photometric not in PLAIN or page.bitspersample == 1:
            return _by_pillow(picture, memory)  # knows them all, but halves the 16 bits of the plain ones
        if page.bitspersample not in (8, 16) or page.axes not in ("YX", "YXS", "SYX"):
            raise ImageError(
                "TIFF images are read as grey or RGB with 8 or 16 bits a channel; "
                f"this one has {page.bitspersample} bits and the axes {page.axes}"
            )
        _see_that_it_fits(picture, -(-page.nbytes // (picture.width * picture.height)), memory)
        tiff_lzw.see_that_it_is_sound(data, page)
        array = np.asarray(page.asarray())
        if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            array = np.invert(array)
        return np.moveaxis(array, 0, -1) if page.axes == "SYX" else array


def see_that_tiles_fit(page: tifffile.TiffPage, memory: int) -> None:
    """See that a tile of a TIFF can be unpacked, which decoders do whole, however little of one the image fills.

    Raises
    ------
    ImageError
    """
    if not page.is_tiled:
        return
    # A tag may be a text, which times a number is a longer text.
    width, height = int(page.tilewidth), int(page.tilelength)
    pixel = -(-page.nbytes // max(int(page.imagewidth) * int(page.imagelength), 1))
    if width * height * max(pixel, 1) > memory:
        raise ImageError(
            f"tiles of {width} x {height} pixels take more than the {memory} bytes allowed for one: write the TIFF "
            "with smaller ones",
            limit=memory,
        )


def _by_pillow(picture: Image.Image, memory: int) -> NDArray[np.uint8]:
    turned = _said_by(picture) if picture.format == "TIFF" else 1  # which Pillow turns itself
    if picture.mode not in ("1", "P", "L", "LA", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr"):
        raise ImageError(f"{picture.format} images are not read with values of the kind {picture.mode!r}")
    as_it_is = picture.mode in ("L", "LA", "RGB", "RGBA")
    _see_that_it_fits(picture, len(picture.getbands()) if as_it_is else 3, memory)
    picture.info.pop("transparency", None)  # of a palette: dropped like an alpha channel
    pixels = np.asarray(picture if as_it_is else picture.convert("RGB"))
    return upright(pixels, {6: 8, 8: 6}.get(turned, turned))  # back


def _see_that_it_fits(picture: Image.Image, pixel: int, memory: int) -> None:
    if picture.width * picture.height * pixel > memory:
        raise ImageError(
            f"an image of {picture.width} x {picture.height} pixels takes more than the {memory} bytes "
            "allowed for one",
            limit=memory,
        )


def encode_png(pixels: Codes) -> bytes:
    """A PNG of (height, width, 1 to 4) uint8 or uint16 values."""
    plane = pixels[:, :, 0] if pixels.shape[2] == 1 else pixels
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(plane)))


def encode_jpeg(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """A JPEG of (height, width, 3) values, its colours at full resolution."""
    return bytes(
        imagecodecs.jpeg8_encode(
            np.ascontiguousarray(pixels), level=quality, subsampling="444", optimize=False
        )
    )


def to_unit(pixels: Codes) -> NDArray[np.float32]:
    """Unsigned integers as float32, 0 to 1."""
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def to_integers(values: NDArray[np.float32], dtype: np.dtype[np.unsignedinteger]) -> Codes:
    """Values as unsigned integers of a type: clipped to 0 to 1, rounded."""
    scaled: Codes = np.rint(np.clip(values, 0, 1) * np.float32(np.iinfo(dtype).max)).astype(dtype)
    return scaled
