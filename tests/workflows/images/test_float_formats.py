"""EXR, Radiance HDR and float TIFF: the very values, and nothing but ImageError from damaged or hostile files."""

import io
import struct
import tracemalloc
from typing import Any

import imagecodecs
import numpy as np
import OpenEXR
import pytest
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.images.decode import decode as decode_backdrop
from workflows.images.float_formats import decode, is_float

MEMORY = 1 << 20
VALUES = np.random.default_rng(4).normal(0.4, 3, (19, 23, 4)).astype(np.float32)
VALUES[0, 0, :3] = np.nan, np.inf, -np.inf


def exr(
    channels: dict[str, NDArray[Any]],
    kind: Any = OpenEXR.scanlineimage,
    pack: Any = OpenEXR.ZIP_COMPRESSION,
    header: dict[str, Any] | None = None,
) -> bytes:
    header = {"compression": pack, "type": kind} | (header or {})
    if kind == OpenEXR.tiledimage:
        header["tiles"] = OpenEXR.TileDescription()
        header["tiles"].xSize = header["tiles"].ySize = 16
    target = io.BytesIO()
    OpenEXR.File(header, {name: np.ascontiguousarray(plane) for name, plane in channels.items()}).write(
        target
    )
    return target.getvalue()


def hdr(pixels: NDArray[np.float32]) -> bytes:
    written = bytes(imagecodecs.rgbe_encode(pixels, header=True))
    head, size, rest = written.partition(b"-Y")
    return head.replace(b"FORMAT", b"# made by a test\nEXPOSURE=1.0\nFORMAT") + size + rest


def tiff(pixels: NDArray[Any], **options: Any) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, **options)
    return target.getvalue()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("pack", [OpenEXR.NO_COMPRESSION, OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION])
@pytest.mark.parametrize("kind", [OpenEXR.scanlineimage, OpenEXR.tiledimage])
def test_an_exr_is_read_exactly(dtype: type, pack: Any, kind: Any) -> None:
    values = VALUES.astype(dtype)
    planes = {name: values[:, :, c] for c, name in enumerate("RGBA")}
    data = exr(planes, kind, pack)
    assert is_float(data)
    np.testing.assert_array_equal(decode(data, memory=MEMORY), values[:, :, :3].astype(np.float32))
    grey = exr({"Y": values[:, :, 1], "depth.Z": values[:, :, 2]}, kind, pack)
    np.testing.assert_array_equal(decode(grey, memory=MEMORY), values[:, :, 1:2].astype(np.float32))


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("compression", [None, "zlib", "lzw"])
def test_a_float_tiff_is_read_exactly(dtype: str, compression: str | None) -> None:
    values = VALUES.astype(dtype)
    files = [
        (values[:, :, :3], values[:, :, :3], "rgb", {}),
        (values[:, :, :3], np.moveaxis(values[:, :, :3], 2, 0), "rgb", {"planarconfig": "separate"}),
        (values[:, :, :3], values, "rgb", {"extrasamples": ["unassalpha"]}),
        (values[:, :, :1], values[:, :, 0], "minisblack", {"rowsperstrip": 5}),
    ]
    for expected, written, kind, layout in files:
        data = tiff(written, photometric=kind, compression=compression, **layout)
        assert is_float(data)
        np.testing.assert_array_equal(decode(data, memory=MEMORY), expected.astype(np.float32))


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("extra", ["unassalpha", "assocalpha", "unspecified"])
def test_a_backdrop_is_black_where_a_float_tiff_is_transparent(channels: int, extra: str) -> None:
    light, alpha = 3 * np.ones((4, 6, channels), np.float32), np.linspace(-0.5, 1.5, 6, dtype=np.float32)
    pixels = np.concatenate([light, np.broadcast_to(alpha[:, np.newaxis], (4, 6, 1))], axis=-1)
    kind = {"photometric": "rgb" if channels == 3 else "minisblack", "planarconfig": "contig"}
    data = tiff(pixels, extrasamples=[extra], **kind)
    clear = np.clip(alpha, 0, 1)[:, np.newaxis] if extra == "unassalpha" else 1
    np.testing.assert_array_equal(decode_backdrop(data, "srgb", memory=MEMORY), light * clear)
    np.testing.assert_array_equal(decode(data, memory=MEMORY), light)


@pytest.mark.parametrize(
    "shape", [pytest.param((9, 16, 3), id="run-length"), pytest.param((3, 5, 3), id="plain")]
)
def test_a_radiance_hdr_is_read(shape: tuple[int, int, int]) -> None:
    random = np.random.default_rng(2)
    light = (100 * random.random((*shape[:2], 1)) ** 8 * random.random(shape)).astype(np.float32)
    data = hdr(light)
    assert is_float(data)
    found = decode(data, memory=MEMORY)
    assert found.dtype == np.float32
    # The largest of three values has eight bits, and the others the same step.
    assert (np.abs(found - light) <= light.max(axis=2, keepdims=True) / 100).all()


def test_integers_and_others_are_no_floats() -> None:
    for data in (b"", b"II", b"MM\0*" + bytes(20), b"\x89PNG", tiff(np.ones((4, 4), np.uint16))):
        assert not is_float(data)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (exr({"Z": VALUES[:, :, 3]}), "has the channels Z: R, G and B, or Y are needed"),
        (
            tiff(
                VALUES[:, :, :2],
                photometric="minisblack",
                planarconfig="contig",
                extrasamples=["unspecified"],
            ),
            None,
        ),
        (
            tiff(
                np.ones((3, 9, 9), np.float32), photometric="minisblack", volumetric=True, tile=(16, 16, 16)
            ),
            "axes",
        ),
        (
            tiff(np.ones((9, 9, 7), np.float32), photometric="minisblack", planarconfig="contig"),
            "grey (and|or) RGB",
        ),
        (hdr(VALUES[1:, :, :3]).replace(b"-Y", b"+Y"), "no upright RGB"),
        (hdr(VALUES[1:, :, :3]).replace(b"rgbe", b"xyze"), "no upright RGB"),
        (hdr(VALUES[1:, :, :3]).replace(b"-Y 18", b"-Y 9999999"), "float pixels"),
    ],
)
def test_unsupported_files_are_refused(data: bytes, why: str | None) -> None:
    if why is None:  # grey with alpha is not odd
        assert decode(data, memory=MEMORY).shape == (19, 23, 1)
        return
    with pytest.raises(ImageError, match=why):
        decode(data, memory=MEMORY)


def test_several_parts_are_refused() -> None:
    part = {"Y": np.ones((4, 5), np.float32)}
    target = io.BytesIO()
    OpenEXR.File([OpenEXR.Part({}, part, "a"), OpenEXR.Part({}, part, "b")]).write(target)
    with pytest.raises(ImageError, match="several parts"):
        decode(target.getvalue(), memory=MEMORY)


def test_the_limit_is_checked_in_the_header() -> None:
    planes = {name: np.zeros((200, 300), np.float32) for name in "RGB"}
    data = exr(planes)
    assert len(data) < 10_000
    with pytest.raises(ImageError, match="300 x 200 float pixels") as caught:
        decode(data, memory=200 * 300 * 24 - 1)
    assert caught.value.fields == {"limit": 200 * 300 * 24 - 1}
    decode(data, memory=200 * 300 * 24)
    packed = tiff(np.zeros((200, 300, 3), np.float32), photometric="rgb", compression="zlib")
    with pytest.raises(ImageError, match="300 x 200 float pixels"):
        decode(packed, memory=200 * 300 * 24 - 1)
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        box = data.index(name) + len(name) + 4
        for corner in (2**30, 2**31 - 1, -5):
            lying = bytearray(data)
            struct.pack_into("<ii", lying, box + 8, corner, corner)
            with pytest.raises(ImageError):
                decode(bytes(lying), memory=MEMORY)


@pytest.mark.parametrize(
    ("left", "top", "width", "height"),
    [(0, 0, 23, 19), (5, 3, 23, 19), (-4, 6, 30, 30), (7, 7, 4, 5), (40, 40, 8, 9), (-9, 30, 4, 60)],
)
@pytest.mark.parametrize("kind", [OpenEXR.scanlineimage, OpenEXR.tiledimage])
def test_an_exr_is_placed_in_its_display_window(
    left: int, top: int, width: int, height: int, kind: Any
) -> None:
    """What lies outside of the data window is black; what lies outside of the display window is cut off."""
    windows = {"dataWindow": (-2, 10, 23, 19), "displayWindow": (left - 2, top + 10, width, height)}
    header = {
        name: (np.array([x, y], np.int32), np.array([x + w - 1, y + h - 1], np.int32))
        for name, (x, y, w, h) in windows.items()
    }
    data = exr({name: VALUES[:, :, c] for c, name in enumerate("RGB")}, kind, header=header)
    surroundings = np.zeros((200, 200, 3), np.float32)
    surroundings[80:99, 80:103] = VALUES[:, :, :3]
    expected = surroundings[80 + top :, 80 + left :][:height, :width]
    np.testing.assert_array_equal(decode(data, memory=MEMORY), expected)


def test_the_limit_holds_for_a_display_window_larger_than_the_data() -> None:
    planes = {name: np.zeros((2, 3), np.float32) for name in "RGB"}
    box = tuple(np.array(end, np.int32) for end in ((0, 0), (299, 199)))
    data = exr(planes, header={"displayWindow": box})
    with pytest.raises(ImageError, match="300 x 200 float pixels"):
        decode(data, memory=200 * 300 * 24 - 1)
    assert decode(data, memory=200 * 300 * 24).shape == (200, 300, 3)


def test_tiles_much_larger_than_the_image_are_refused() -> None:
    data = bytearray(
        tiff(np.zeros((16, 16, 3), np.float32), photometric="rgb", tile=(16, 16), compression="zlib")
    )
    width = data.index(struct.pack("<HHII", 322, 4, 1, 16))  # TileWidth
    decode(bytes(data), memory=MEMORY)
    struct.pack_into("<I", data, width + 8, 1 << 24)
    with pytest.raises(ImageError, match="tiles of 16777216 x 16 pixels"):
        decode(bytes(data), memory=MEMORY)


def test_tiff_with_text_as_its_width_takes_no_memory() -> None:
    data = bytearray(tiff(np.zeros((16, 16, 3), np.float32), photometric="rgb", tile=(16, 16)))
    for tag, kind, value in ((256, 2, ord("$")), (257, 4, 1 << 30)):  # ImageWidth, ImageLength
        at = data.index(struct.pack("<HHII", tag, 4, 1, 16))
        struct.pack_into("<HHII", data, at, tag, kind, 1, value)
    tracemalloc.start()
    try:
        with pytest.raises(ImageError):
            decode(bytes(data), memory=MEMORY)
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["exr", "hdr", "tiff"])
def test_a_truncated_file_is_refused(kind: str) -> None:
    planes = {name: VALUES[:, :, c] for c, name in enumerate("RGB")}
    data = {
        "exr": lambda: exr(planes),
        "hdr": lambda: hdr(np.abs(VALUES[1:, :, :3])),
        "tiff": lambda: tiff(VALUES[:, :, :3], photometric="rgb", compression="zlib"),
    }[kind]()
    for length in np.linspace(4, len(data) * 0.95, 30).astype(int):
        with pytest.raises(ImageError):
            decode(data[:length], memory=MEMORY)
