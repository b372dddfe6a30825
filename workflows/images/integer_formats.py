"""PNG, JPEG, TIFF, HEIC and web formats of 8 to 16 bits to arrays, and PNG and JPEG back. Files are not trusted."""

import io
import re
from contextlib import suppress
from typing import IO, Any, cast

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image, JpegImagePlugin

from storage.errors import ImageError
from workflows.images import heif, web_formats
from workflows.images.orientation import ORIENTATION, inverse, upright
from workflows.images.writers.png import write_png
from workflows.untrusted import tiff_lzw
from workflows.untrusted.limits import check_size

Codes = NDArray[np.unsignedinteger]
"""Values as a file stores them: uint8 or uint16."""
FORMATS = ("PNG", "TIFF", "JPEG")
"""What Pillow opens of a capture."""
Image.MAX_IMAGE_PIXELS = None  # `check_size` has the limit
LOSSLESS = {
    tifffile.COMPRESSION.NONE,
    tifffile.COMPRESSION.LZW,
    tifffile.COMPRESSION.ADOBE_DEFLATE,
    tifffile.COMPRESSION.DEFLATE,
    tifffile.COMPRESSION.PACKBITS,
    tifffile.COMPRESSION.LZMA,
    tifffile.COMPRESSION.ZSTD,
}
"""TIFF compressions that tifffile decodes within the size that the header states."""
PLAIN = {tifffile.PHOTOMETRIC.MINISWHITE, tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB}
"""Photometric interpretations of a TIFF whose values are used as they are."""
SAVE_IT = "save it as grey or RGB with 8 or 16 bits a channel"
MARKER = re.compile(rb"\xff([\x02-\xcf\xd9-\xfe])")
"""A marker of a JPEG other than those that stand alone, of which a scan may hold some (ITU-T T.81, table B.1)."""
END, SCAN = b"\xd9", b"\xda"
SEGMENTS = 10_000
"""Segments of a JPEG that are looked at: those of cameras have some dozens."""
SCANS = 100
"""Scans of a JPEG: each takes as long as a picture, but only a few bytes. Encoders write about ten."""


def orientation(data: bytes) -> int:
    """The EXIF orientation of an image for `upright`, 1 to 8; 1, which is no turn, if there is none.

    It is also 1 if the image can't be read.
    """
    if heif.is_heif(data):
        return heif.orientation(data)
    try:
        if data.startswith((b"II", b"MM")):  # Pillow does not open them all
            with tifffile.TiffFile(io.BytesIO(data)) as file:
                return _valid(file.pages[0].tags.valueof(ORIENTATION))
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            return _orientation_of(picture)
    except Exception:  # damaged bytes raise many kinds of errors
        return 1


def halves_colour(data: bytes) -> bool:
    """Whether an image stores colour at a lower resolution than brightness, as most JPEG and HEIC do.

    It is false if the image can't be read.
    """
    try:
        if heif.is_heif(data):
            return heif.halves_colour(data)
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            return JpegImagePlugin.get_sampling(picture) > 0
    except Exception:  # damaged bytes raise many kinds of errors
        return False


def transfer(data: bytes) -> int:
    """The transfer characteristics of a HEIC (ITU-T H.273, table 3); 0 of other images, or if it can't be read."""
    try:
        return heif.transfer(data) if heif.is_heif(data) else 0
    except ImageError:
        return 0


def decode(
    data: bytes,
    *,
    memory: int,
    alpha: bool = False,
    turn: int | None = None,
    full: float = 1.0,
    formats: tuple[str, ...] = FORMATS,
) -> Codes:
    """Decode an image.

    Parameters
    ----------
    data : bytes
        HEIC, or one of ``formats``. Of a moving picture the first frame is decoded.
    memory : int
        Bytes that the decoded image may take; checked by the header, before anything is decoded.
    alpha : bool
        Whether to keep an alpha channel.
    turn : int, optional
        Orientation, see `upright`; by default the file's own.
    full : float
        The light of HEIC for HDR displays that becomes full scale, see `hdr.to_srgb`.
    formats : tuple of str
        What Pillow may open.

    Returns
    -------
    (height, width, 1 or 3) uint8 or uint16
        Upright, grey or RGB; a palette is looked up. With alpha if it is kept and exists; that of a palette is dropped,
        and alpha that colours are multiplied with already.

    Raises
    ------
    ImageError
        If it is not one of the formats, damaged, too large, or has another type or number of channels.
    """
    if heif.is_heif(data):
        return _kept(heif.decode(data, memory=memory, turn=turn, full=full), alpha)
    if "WEBP" in formats:
        web_formats.check_webp(data, memory)
    try:
        picture = Image.open(io.BytesIO(data), formats=formats)
    except Exception as error:  # damaged bytes raise many kinds of errors
        raise ImageError(_not_opened(data, formats)) from error
    if picture.format == "PNG" and getattr(picture, "is_animated", False):
        raise ImageError("this PNG is animated: save a single picture")
    if picture.format in ("JPEG", "MPO") and _scans(data) > SCANS:
        raise ImageError(f"this JPEG has more than {SCANS} scans: save it again", limit=SCANS)
    own = _orientation_of(picture)  # read first, because decoding removes it from a TIFF
    try:
        pixels = _pixels(data, picture, memory)
    except ImageError:
        raise
    except Exception as error:
        raise ImageError(
            f"the {picture.format} image is cut off or damaged: copy it again from the camera, or save it again"
        ) from error
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim != 3 or pixels.shape[2] not in (1, 2, 3, 4):
        raise ImageError(
            f"this {picture.format} has {pixels.shape[-1]} channels of type {pixels.dtype}: {SAVE_IT}"
        )
    return upright(_kept(pixels, alpha), own if turn is None else turn)


def _not_opened(data: bytes, formats: tuple[str, ...]) -> str:
    """Why Pillow does not open an image."""
    with suppress(Exception), tifffile.TiffFile(io.BytesIO(data)) as file:
        channels, bits = int(file.pages[0].samplesperpixel), int(file.pages[0].bitspersample)
        if channels not in (1, 3):
            return f"this TIFF has {channels} channels of {bits} bits, which is not supported: {SAVE_IT}"
    return (
        f"this is not a {', '.join(formats)} or HEIC image, or it is cut off: copy it again from the camera, or "
        "save it as PNG"
    )


def _scans(data: bytes) -> int:
    """The scans of a JPEG. What follows its end does not count: phones append films of several megabytes."""
    at = scans = 0
    for _ in range(SEGMENTS):
        found = MARKER.search(data, at)
        if not found or found[1] == END:
            return scans
        scans += found[1] == SCAN
        at = found.end() + int.from_bytes(data[found.end() : found.end() + 2], "big")
    return SCANS + 1


def _kept(pixels: NDArray[np.generic], alpha: bool) -> Codes:
    """Pixels without their alpha channel, unless it is to be kept."""
    return cast("Codes", pixels if alpha else pixels[:, :, : 3 if pixels.shape[2] > 2 else 1])


def _orientation_of(picture: Image.Image) -> int:
    """The orientation of an image, without decoding it."""
    # For a PNG without EXIF before the pixels, Pillow would decode these to look behind them.
    if picture.format == "PNG" and "exif" not in picture.info:
        return 1
    try:
        return _valid(picture.getexif().get(ORIENTATION))
    except Exception:  # damaged bytes raise many kinds of errors
        return 1


def _valid(orientation: Any) -> int:
    """An orientation that a file states; 1, which is no turn, if there is none like it."""
    return int(orientation) if orientation in range(1, 9) else 1


def _pixels(data: bytes, picture: Image.Image, memory: int) -> NDArray[np.generic]:
    if picture.format == "TIFF":
        array = _tiff(data, picture, memory)
    elif picture.format == "PNG" and data[24] == 16:  # the bit depth in IHDR (PNG, sect. 11.2.1)
        check_size(*picture.size, 2 * len(picture.getbands()), memory)
        array = imagecodecs.png_decode(data)  # Pillow would reduce it to 8 bits
    else:
        array = _by_pillow(picture, memory)
    return array if array.ndim == 3 else array[..., np.newaxis]


def _tiff(data: bytes, picture: Image.Image, memory: int) -> NDArray[np.generic]:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages[0]
        check_tiles(page, memory)
        if page.compression not in LOSSLESS or page.photometric not in PLAIN or page.bitspersample == 1:
            return _by_pillow(picture, memory)  # supports them all, but reduces 16 bits to 8
        if (
            page.bitspersample not in (8, 16)
            or page.axes not in ("YX", "YXS", "SYX")
            or page.samplesperpixel > 4
        ):
            raise ImageError(
                f"this TIFF has {page.samplesperpixel} channels of {page.bitspersample} bits "
                f"and the axes {page.axes}: {SAVE_IT}"
            )
        check_size(*picture.size, -(-page.nbytes // (picture.width * picture.height)), memory)
        tiff_lzw.check_lzw(data, page)
        array = np.asarray(page.asarray())
        array = array[..., np.newaxis] if page.axes == "YX" else array
        array = np.moveaxis(array, 0, -1) if page.axes == "SYX" else array
        colours = 3 if page.photometric == tifffile.PHOTOMETRIC.RGB else 1
        if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            array = np.invert(array)
        return array[..., : colours + has_alpha(page)]


def has_alpha(page: tifffile.TiffPage) -> bool:
    """Whether a TIFF has transparency beside its colours.

    Notes
    -----
    TIFF 6.0, ExtraSamples: associated alpha is in the colours already, and unspecified samples are no alpha.
    """
    return bool(page.extrasamples[:1] == (tifffile.EXTRASAMPLE.UNASSALPHA,))


def check_tiles(page: tifffile.TiffPage, memory: int) -> None:
    """Check that a tile of a TIFF fits into memory: decoders unpack whole tiles, however little the image fills.

    Raises
    ------
    ImageError
    """
    if not page.is_tiled:
        return
    # A tag may be a string, and multiplying it would make a longer string.
    width, height = int(page.tilewidth), int(page.tilelength)
    pixel = -(-page.nbytes // max(int(page.imagewidth) * int(page.imagelength), 1))
    if width * height * max(pixel, 1) > memory:
        raise ImageError(
            f"tiles of {width} x {height} pixels take more than the {memory} bytes allowed for one: write the TIFF "
            "with smaller ones",
            limit=memory,
        )


def _by_pillow(picture: Image.Image, memory: int) -> NDArray[np.uint8]:
    turned = _orientation_of(picture) if picture.format == "TIFF" else 1  # Pillow turns a TIFF itself
    if picture.mode not in ("1", "P", "L", "LA", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr"):
        raise ImageError(f"{picture.format} images of mode {picture.mode!r} are not supported")
    as_it_is = picture.mode in ("L", "LA", "RGB", "RGBA")
    seen_through = picture.format == "GIF" and "transparency" in picture.info
    check_size(*picture.size, len(picture.getbands()) if as_it_is else 4 if seen_through else 3, memory)
    if not seen_through:
        picture.info.pop("transparency", None)  # transparency of a palette is dropped
    pixels = np.asarray(picture if as_it_is else picture.convert("RGBA" if seen_through else "RGB"))
    return upright(pixels, inverse(turned))


def encode_png(pixels: Codes) -> bytes:
    """Encode (height, width, 1 to 4) uint8 or uint16 values as PNG."""
    file = io.BytesIO()
    save_png(file, pixels)
    return file.getvalue()


def save_png(file: IO[bytes], pixels: Codes) -> None:
    """Write (height, width, 1 to 4) uint8 or uint16 values as PNG."""
    height, width, channels = pixels.shape
    write_png(file, width, height, channels, pixels.dtype.type, [pixels])


def encode_jpeg(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """Encode (height, width, 3) values as JPEG with colours at full resolution (4:4:4)."""
    return bytes(
        imagecodecs.jpeg8_encode(
            np.ascontiguousarray(pixels), level=quality, subsampling="444", optimize=False
        )
    )


def to_unit(pixels: Codes) -> NDArray[np.float32]:
    """Scale unsigned integers to float32, 0 to 1."""
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def to_integers(values: NDArray[np.float32], dtype: np.dtype[np.unsignedinteger]) -> Codes:
    """Values as unsigned integers of a type, clipped to 0 to 1 and rounded."""
    scaled: Codes = np.rint(np.clip(values, 0, 1) * np.float32(np.iinfo(dtype).max)).astype(dtype)
    return scaled
