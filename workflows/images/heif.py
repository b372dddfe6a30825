"""HEIC and other HEIF pictures in HEVC, the stills of phones and of some cameras. The files are not trusted."""

import struct
from collections.abc import Iterator
from typing import Any

import imagecodecs
import numpy as np
import pillow_heif
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.hdr import is_hdr, to_srgb
from workflows.images.orientation import inverse, upright
from workflows.images.tone_curves import to_light
from workflows.untrusted.limits import check_size

BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1"})
"""What such a file calls itself in its first box (ISO/IEC 23008-12, sect. 10). The last two may hold other codecs."""
NOT_WIDE = (1, 2)
"""Colour primaries (ITU-T H.273, table 2) that are sRGB's, or not stated."""
PROPERTIES = 10_000
"""Boxes that are looked at to find the orientation: a picture of 1,000 tiles has some dozens of properties."""

# One thread, as for everything else in a worker; thumbnails and the like are not read.
pillow_heif.options.DECODE_THREADS = 1
pillow_heif.options.THUMBNAILS = False
pillow_heif.options.DEPTH_IMAGES = False
pillow_heif.options.AUX_IMAGES = False


def is_heif(data: bytes) -> bool:
    """Whether bytes are HEIF and not AVIF, judging by their first box."""
    also = data[16 : int.from_bytes(data[:4], "big")]  # its other brands
    return data[4:8] == b"ftyp" and data[8:12] in BRANDS and b"avif" not in also


def halves_colour(data: bytes) -> bool:
    """Whether the main picture stores colour at half the resolution. Damaged bytes raise many kinds of errors."""
    return pillow_heif.open_heif(data).info["chroma"] in (420, 422)


def transfer(data: bytes) -> int:
    """The transfer characteristics of the main picture; 0 if none are stated.

    Raises
    ------
    ImageError
    """
    return int(_stated(_opened(data)).get("transfer_characteristics", 0))


def decode(
    data: bytes, *, memory: int, turn: int | None = None, full: float = 1.0
) -> NDArray[np.unsignedinteger]:
    """Decode the main picture of a HEIF.

    Parameters
    ----------
    data : bytes
    memory : int
        Bytes that the decoded picture may take; checked by the header, before anything is decoded.
    turn : int, optional
        Orientation, see `orientation.upright`; by default the file's own.
    full : float
        The light of HDR that becomes full scale, see `hdr.to_srgb`.

    Returns
    -------
    (height, width, 1, 3 or 4) uint8 or uint16
        Upright, grey or RGB, with alpha if there is one. 10 and 12 bits are stretched to 16: their largest code becomes
        65535. Codes for HDR displays are converted to sRGB.

    Raises
    ------
    ImageError
        If it is damaged, too large, or of another codec than HEVC.
    """
    picture = _opened(data)
    name, _, depth = picture.mode.partition(";")
    deep, stated = bool(depth), _stated(picture)
    is_for_hdr = is_hdr(stated.get("transfer_characteristics", 0))
    check_size(
        *picture.size, (2 if deep or is_for_hdr else 1) * (1 if name in ("L", "I") else len(name)), memory
    )
    try:
        pixels = np.asarray(picture)
    except Exception as error:
        raise _refusal(error) from _cause(error)
    pixels = pixels if pixels.ndim == 3 else pixels[..., np.newaxis]
    if name.endswith("a"):
        # Colours are multiplied with alpha already: black shines through, as it does behind all that is transparent.
        pixels = pixels[..., :-1]
    if deep:
        bits = int(_info(picture)["bit_depth"])
        pixels = (pixels << (16 - bits)) | (pixels >> (2 * bits - 16))
    if is_for_hdr:
        pixels = (pixels if deep else pixels * np.uint16(257)).astype(np.uint16, copy=False)
        colours = pixels[..., :3]  # without alpha, if there is one
        colours[:] = to_srgb(colours, stated["transfer_characteristics"], stated["color_primaries"], full)
    # The library has turned it by the file's own orientation.
    if turn is not None and (own := orientation(data)) != turn:
        pixels = upright(upright(pixels, inverse(own)), turn)
    return np.ascontiguousarray(pixels)


def profile(data: bytes) -> bytes | None:
    """The ICC profile of what is decoded, or one made of the primaries that are stated; None if its colours are sRGB's.

    Raises
    ------
    ImageError
    """
    info = _info(_opened(data))
    stated = info.get("nclx_profile")
    if stated and is_hdr(stated["transfer_characteristics"]):
        return None  # `decode` has converted them
    if info.get("icc_profile") or not stated or stated["color_primaries"] in NOT_WIDE:
        return info.get("icc_profile")
    primaries = [stated[f"color_primary_{name}_{axis}"] for name in ("red", "green", "blue") for axis in "xy"]
    white = [stated["color_primary_white_x"], stated["color_primary_white_y"]]
    curve = to_light(np.linspace(0, 1, 4096, dtype=np.float32), "srgb")
    try:
        return bytes(
            imagecodecs.cms_profile("rgb", whitepoint=white, primaries=primaries, transferfunction=curve)
        )
    except Exception as error:  # primaries of damaged files make no profile
        raise _refusal(error) from error


def orientation(data: bytes) -> int:
    """How `decode` has turned the picture, as an EXIF orientation; 1, which is no turn, if that can't be read.

    Notes
    -----
    A HEIF is turned by the properties ``irot`` and ``imir`` of its main item (ISO/IEC 23008-12, sect. 6.5.10 and
    6.5.12), in the order in which they are associated with it. Its EXIF repeats that for programs that read no HEIF.
    """
    try:
        turns = list(_turns(data))
    except Exception:  # damaged bytes raise many kinds of errors
        return 1
    stored = np.arange(6).reshape(2, 3)
    shown = stored
    for kind, value in turns:
        shown = np.rot90(shown, value & 3) if kind == b"irot" else np.flip(shown, value & 1)
    return next(turn for turn in range(1, 9) if np.array_equal(upright(stored, turn), shown))


def _opened(data: bytes) -> pillow_heif.HeifImage:
    """The main picture, whose pixels are not decoded yet."""
    try:
        file = pillow_heif.open_heif(data, convert_hdr_to_8bit=False, hdr_to_16bit=False)
        return file[file.primary_index]
    except Exception as error:  # damaged bytes raise many kinds of errors
        raise _refusal(error) from _cause(error)


def _info(picture: pillow_heif.HeifImage) -> dict[str, Any]:
    return dict(picture.info)


def _stated(picture: pillow_heif.HeifImage) -> dict[str, Any]:
    """The colours that a picture states in numbers."""
    return _info(picture).get("nclx_profile") or {}


def _refusal(error: Exception) -> ImageError:
    if isinstance(error, SyntaxError):  # how the library reports what it does not support
        return ImageError("this HEIF is of a kind that is not supported: save it as HEIC (HEVC), JPEG or PNG")
    return ImageError(
        "the HEIC image is cut off or damaged: copy it again from the camera, or save it as JPEG or PNG"
    )


def _cause(error: Exception) -> Exception:
    """The error, as a `MemoryError` where the library reports one in words."""
    return MemoryError(str(error)) if "memory" in str(error).lower() else error


def _turns(data: bytes) -> Iterator[tuple[bytes, int]]:
    """The properties of the main item that turn it, in order: their kind, and the byte that says how."""
    meta = dict(_boxes(data, 0, len(data)))[b"meta"]
    parts = dict(_boxes(data, meta.start + 4, meta.stop))
    version, main = data[parts[b"pitm"].start], parts[b"pitm"].start + 4
    (item,) = struct.unpack_from(">I" if version else ">H", data, main)
    properties = dict(_boxes(data, parts[b"iprp"].start, parts[b"iprp"].stop))
    found = list(_boxes(data, properties[b"ipco"].start, properties[b"ipco"].stop))
    for number in _associated(data, properties[b"ipma"].start, item):
        kind, body = found[number - 1]
        if kind in (b"irot", b"imir"):
            yield kind, data[body.start]


def _boxes(data: bytes, at: int, stop: int) -> Iterator[tuple[bytes, range]]:
    """The boxes in a part of the file (ISO/IEC 14496-12, sect. 4.2): their kinds, and where their contents are."""
    for _ in range(PROPERTIES):
        if at + 8 > stop:
            return
        size, kind = struct.unpack_from(">I4s", data, at)
        head = 8
        if size == 1:
            head, (size,) = 16, struct.unpack_from(">Q", data, at + 8)
        end = stop if size == 0 else at + size
        yield kind, range(at + head, end)
        at = max(end, at + head)


def _associated(data: bytes, at: int, item: int) -> list[int]:
    """The numbers, from 1, of the properties of an item, by the box ``ipma`` whose contents begin at ``at``."""
    version, wide = data[at], data[at + 3] & 1
    (entries,) = struct.unpack_from(">I", data, at + 4)
    at += 8
    for _ in range(min(entries, PROPERTIES)):
        (found,) = struct.unpack_from(">I" if version else ">H", data, at)
        at += 4 if version else 2
        count, at = data[at], at + 1
        # The highest bit of a number says that the property must be understood.
        numbers = struct.unpack_from(f">{count}{'H' if wide else 'B'}", data, at)
        if found == item:
            return [number & (0x7FFF if wide else 0x7F) for number in numbers]
        at += count * (2 if wide else 1)
    return []
