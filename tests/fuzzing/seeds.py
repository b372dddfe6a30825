"""Small valid files for every parser, made by common libraries."""

import io
import json
from fractions import Fraction
from functools import cache
from typing import Any

import av
import imagecodecs
import numpy as np
import OpenEXR
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms

from tests.parts.inputs.dngs import dng
from tests.parts.inputs.heics import heic
from workflows.images.integer_formats import encode_png

Files = tuple[bytes, ...]
"""Valid files."""
PIXELS = np.random.default_rng(9).integers(0, 255, (24, 36, 3), np.uint8)
LIGHT = (PIXELS / 255).astype(np.float32)
COUNTS = PIXELS[:, :, 0].astype(np.uint16) * 16
MANIFEST: dict[str, Any] = {
    "format": "envmatte-capture/1",
    "name": "ball",
    "program": {
        "monitor": {"width": 64, "height": 48, "response": {"gamma": 2.2}},
        "parts": [
            {"kind": "constant", "levels": [0, 0.5, 1]},
            {"kind": "constant", "colours": [[0, 0, 0], [1, 0, 0.5]]},
            {"kind": "bernoulli", "columns": 4, "rows": 3, "count": 2, "seed": 1, "offset": True},
            {"kind": "bernoulli", "columns": 8, "rows": 3, "count": 1, "seed": 2, "colour": "rgb"},
            {"kind": "stripes", "axis": "x", "count": 2, "colour": "rgb"},
            {"kind": "images", "files": ["a.png"]},
        ],
    },
    "response": "unknown",
    "frames": [{"file": f"{n}.png", "pattern": n, "exposure": 0.5} for n in range(11)],
    "mask": "a.png",
}
FILMED = MANIFEST | {
    "frames": [],
    "video": {
        "file": "0.png",
        "patterns_per_second": 2.0,
        "border": {"width": 100, "height": 80},
    },
}


def capture_files(manifest: dict[str, Any] = MANIFEST) -> dict[str, bytes]:
    """The entries of a capture archive. Its frames are no images, which its parser does not look into."""
    names = ("a.png", *(f"{n}.png" for n in range(11)))
    return {"capture.json": json.dumps(manifest).encode(), **{name: name.encode() * 9 for name in names}}


def _saved(kind: str, mode: str = "RGB", **options: Any) -> bytes:
    target = io.BytesIO()
    Image.fromarray(PIXELS).convert(mode).save(target, kind, **options)
    return target.getvalue()


@cache
def pngs() -> tuple[bytes, ...]:
    profile = _dated(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    alpha = np.dstack([PIXELS, PIXELS[:, :, 0]])
    return (
        encode_png(PIXELS),
        encode_png(PIXELS.astype(np.uint16) * 257),
        encode_png(alpha),
        encode_png(PIXELS[:, :, :1]),
        _saved("PNG", icc_profile=profile),
        _saved("PNG", "P"),
        _saved("PNG", "1"),
    )


@cache
def jpegs() -> tuple[bytes, ...]:
    profile = _dated(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    return (
        _saved("JPEG", quality=80),
        _saved("JPEG", progressive=True, quality=50),
        _saved("JPEG", "L"),
        _saved("JPEG", "CMYK"),
        _saved("JPEG", icc_profile=profile),
        _saved("JPEG", exif=_exif()),
    )


@cache
def webs() -> tuple[bytes, ...]:
    """WebP, AVIF and GIF."""
    alpha = Image.fromarray(np.dstack([PIXELS, PIXELS[:, :, 0]]))
    files = [_saved(kind, mode) for kind in ("WEBP", "AVIF", "GIF") for mode in ("RGB", "P", "L")]
    for kind in ("WEBP", "AVIF", "GIF"):
        target = io.BytesIO()
        alpha.save(target, kind, save_all=True, append_images=[alpha.rotate(180)])
        files.append(target.getvalue())
    return (*files, _saved("WEBP", lossless=True, exif=_exif()))


@cache
def heics() -> tuple[bytes, ...]:
    profile = _dated(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    pixels = np.tile(PIXELS, (3, 2, 1))
    return (
        heic(pixels, 6),
        heic(np.dstack([pixels, pixels[:, :, :1]]), quality=50),
        heic(pixels[:, :, :1], 7),
        heic(pixels.astype(np.uint16) * 4),
        heic(pixels, icc_profile=profile, icc_profile_type="prof"),
        heic(pixels, 4, color_primaries=12, transfer_characteristics=13),
        heic(np.tile(pixels, (2, 2, 1)), tile_size=64, quality=50),
    )


def _exif() -> bytes:
    exif = Image.Exif()
    exif[274] = 6
    return exif.tobytes()


def _tiff(pixels: NDArray[Any], **options: Any) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, **{"photometric": "rgb", **options})
    return target.getvalue()


@cache
def tiffs() -> tuple[bytes, ...]:
    deep = PIXELS.astype(np.uint16) * 257
    return (
        _tiff(PIXELS, compression="lzw", rowsperstrip=5),
        _tiff(PIXELS),
        _tiff(deep, compression="zlib", predictor=True),
        _tiff(deep, tile=(16, 16), compression="zstd"),
        _tiff(deep, byteorder=">", compression="packbits"),
        _tiff(np.moveaxis(PIXELS, 2, 0), planarconfig="separate", compression="lzma"),
        _tiff(PIXELS[:, :, 0], photometric="miniswhite"),
        _tiff(PIXELS, tile=(16, 16), compression="jpeg"),
        _saved("TIFF", "1", compression="group4"),
        _saved("TIFF", "P", compression="tiff_lzw"),
        _saved("TIFF", "CMYK"),
        _tiff(PIXELS, bigtiff=True, tile=(16, 16), compression="zlib"),
    )


@cache
def float_tiffs() -> tuple[bytes, ...]:
    return (
        _tiff(LIGHT),
        _tiff(LIGHT, compression="zlib", predictor=True),
        _tiff(LIGHT.astype(np.float16), tile=(16, 16), compression="lzw"),
        _tiff(LIGHT.astype(np.float64), byteorder=">", compression="zstd"),
        _tiff(np.moveaxis(LIGHT, 2, 0), planarconfig="separate"),
        _tiff(LIGHT[:, :, 0], photometric="minisblack", bigtiff=True),
    )


def _exr(pack: Any, tile: int = 0, dtype: Any = np.float32, **channels: NDArray[Any]) -> bytes:
    header = {"compression": pack, "type": OpenEXR.tiledimage if tile else OpenEXR.scanlineimage}
    if tile:
        header["tiles"] = OpenEXR.TileDescription()
        header["tiles"].xSize = header["tiles"].ySize = tile
    target = io.BytesIO()
    OpenEXR.File(header, channels or {"RGB": LIGHT.astype(dtype)}).write(target)
    return target.getvalue()


@cache
def exrs() -> tuple[bytes, ...]:
    packs = (
        "NO",
        "RLE",
        "ZIPS",
        "ZIP",
        "PIZ",
        "PXR24",
        "B44",
        "B44A",
        "DWAA",
        "DWAB",
        "HTJ2K",
        "HTJ2K256",
        "HTJ2K32",
    )
    known = [
        getattr(OpenEXR, f"{pack}_COMPRESSION") for pack in packs if hasattr(OpenEXR, f"{pack}_COMPRESSION")
    ]
    return (
        *(_exr(pack, dtype=dtype) for pack in known for dtype in (np.float16, np.float32)),
        _exr(OpenEXR.PIZ_COMPRESSION, 16),
        _exr(OpenEXR.ZIP_COMPRESSION, 8, np.float16),
        _exr(OpenEXR.ZIP_COMPRESSION, Y=LIGHT[:, :, 0], id=PIXELS[:, :, 0].astype(np.uint32)),
    )


MAGICS = (
    *(
        b"FUJIFILMCCD-RAW 0201",
        b"FOVb\0\0\x02\0",
        b"IIII\x04\0\x04\0\x08\0\0\0",
        b"MMMMRaw\0",
        b"\0MRM\0\0\1\0\0PRD",
    ),
    *(b"II\x1a\0\0\0HEAPCCDR", b"RIFF\0\1\0\0AVI ", b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", b"IIRO\x08\0\0\0"),
    *(
        b"IIRS\x08\0\0\0",
        b"IIU\0\x18\0\0\0",
        b"II*\0\x10\0\0\0CR\2\0",
        b"PWAD",
        b"DSC-Image",
        b"qktk\0\0",
        b"NOKIARAW",
    ),
    *(
        b"BM",
        b"BR",
        b"ARRI",
        b"XPDS",
        b"nikon\0",
        b"\xff\xd8\xff\xe1\0\x40Exif\0\0II*\0\x08\0\0\0",
        b"GPMF",
        b"STARTOF",
    ),
)
"""First bytes of formats other than DNG that LibRaw reads, files of which cannot be made here."""


@cache
def raws() -> tuple[bytes, ...]:
    linear = PIXELS.astype(np.uint16) * 16
    xtrans = tuple("GBR".index(c) for c in "GBGGRGRGRBGBGBGGRGGRGGBGBGBRGRGGBG"[:36].ljust(36, "G"))
    return (
        dng(COUNTS, 100, 4095),
        dng(COUNTS, 100, 4095, active=(2, 2, 22, 34)),
        dng(COUNTS, 100, 4095, pattern=xtrans),
        dng(linear, 100, 4095),
        dng(COUNTS, 100, 4095, tile=(16, 16)),
        dng(COUNTS, 100, 4095, compression="zlib"),
        dng(COUNTS, 100, 4095, compression="jpeg"),
    )


def backdrops() -> tuple[bytes, ...]:
    return (*pngs(), *jpegs(), *exrs(), *heics(), *webs(), *raws())


def profile() -> bytes:
    """A colour profile with many kinds of tags."""
    return _dated(imagecodecs.cms_profile("srgb"))


def _dated(profile: bytes) -> bytes:
    """A colour profile with a fixed date of creation (ICC.1, sect. 7.2.8) in place of now."""
    return profile[:24] + bytes((7, 208, 0, 1, 0, 1)) + bytes(6) + profile[36:]


def _clip(container: str, codec: str, form: str, **options: str) -> bytes:
    target = io.BytesIO()
    with av.open(target, "w", format=container, options={"fflags": "+bitexact"}) as box:
        stream = box.add_stream(codec, rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt, stream.options = 64, 64, form, options
        stream.codec_context.thread_count = 1
        for n in range(9):
            code = np.full((64, 64, 3), 25 * n, np.uint8)
            code[24:40, 4 * n : 4 * n + 12] = PIXELS[:16, :12]
            for packet in stream.encode(av.VideoFrame.from_ndarray(code, format="rgb24")):
                box.mux(packet)
        for packet in stream.encode():
            box.mux(packet)
    return target.getvalue()


# No AV1: as root its encoder SVT-AV1 gives its process real-time priority, which starves all others.
CLIPS: tuple[tuple[Any, ...], ...] = (
    ("mp4", "libx264", "yuv420p", {"preset": "veryfast", "g": "4", "bf": "2"}),
    ("mp4", "libx264", "yuv422p10le", {"preset": "veryfast"}),
    ("matroska", "libx264", "yuv420p", {"preset": "veryfast"}),
    ("mp4", "libx265", "yuv420p", {"preset": "ultrafast", "x265-params": "log-level=none"}),
    ("mov", "mjpeg", "yuvj422p", {}),
    ("avi", "mjpeg", "yuvj420p", {}),
    ("avi", "mpeg4", "yuv420p", {}),
    ("mpegts", "libx264", "yuv420p", {"preset": "veryfast", "g": "4", "x264-params": "tff=1"}),
    ("mpegts", "mpeg2video", "yuv420p", {}),
    ("webm", "libvpx", "yuv420p", {}),
    ("webm", "libvpx-vp9", "yuv420p", {}),
    ("mov", "prores_ks", "yuv422p10le", {}),
    ("matroska", "ffv1", "yuv444p", {"level": "3", "slicecrc": "0"}),
    ("matroska", "ffv1", "gray", {"level": "1"}),
)


@cache
def clips() -> tuple[bytes, ...]:
    """A clip in every container and codec that has an encoder."""
    return tuple(
        _clip(container, codec, form, **options)
        for container, codec, form, options in CLIPS
        if codec in av.codecs_available
    )
