"""Image files: exact values of every kind that is read, and nothing but ImageError from every other."""

import io
import struct
import time
import tracemalloc
import zlib
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from storage.errors import ImageError
from tests.parts.inputs.heics import heic
from workflows.images.integer_formats import (
    decode,
    encode_jpeg,
    encode_png,
    halves_colour,
    to_integers,
    to_unit,
)

MEMORY = 1 << 20


def noise(shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    return np.random.default_rng(9).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def tiff(pixels: NDArray[Any], **options: Any) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, **options)
    return target.getvalue()


def saved(picture: Image.Image, kind: str, **options: Any) -> bytes:
    target = io.BytesIO()
    picture.save(target, kind, **options)
    return target.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def claimed_png(width: int, height: int, depth: int = 8, colour: int = 2) -> bytes:
    """A PNG of some bytes that claims a size."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_a_png_is_read_exactly(dtype: str, channels: int) -> None:
    pixels = noise((13, 17, channels), dtype)
    kept = 1 if channels < 3 else 3
    again = encode_png(decode(encode_png(pixels[:, :, :kept]), memory=MEMORY))
    for data in (encode_png(pixels), imagecodecs.png_encode(pixels, level=9), again):
        got = decode(bytes(data), memory=MEMORY)
        assert got.dtype == dtype
        assert got.flags.c_contiguous
        np.testing.assert_array_equal(got, pixels[:, :, :kept])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("compression", [None, "lzw", "zlib", "packbits", "zstd", "lzma"])
def test_a_tiff_is_read_exactly(dtype: str, byteorder: str, compression: str | None) -> None:
    grey, colour, alpha = (noise((33, 21, c), dtype) for c in (1, 3, 4))
    files = [
        (grey, grey[..., 0], {"photometric": "minisblack"}),
        (np.iinfo(dtype).max - grey, grey[..., 0], {"photometric": "miniswhite"}),
        (colour, colour, {"photometric": "rgb"}),
        (colour, np.moveaxis(colour, -1, 0), {"photometric": "rgb", "planarconfig": "separate"}),
        (alpha, alpha, {"photometric": "rgb", "extrasamples": ["unassalpha"]}),
    ]
    layouts: list[dict[str, Any]] = [{}, {"rowsperstrip": 7}, {"tile": (16, 16)}]
    if compression in ("lzw", "zlib"):
        layouts.append({"predictor": True})
    if (dtype, byteorder) == ("uint16", ">"):
        del files[1]  # the one that Pillow, which looks at files first, does not know
    for expected, written, kind in files:
        for layout in layouts:
            data = tiff(written, byteorder=byteorder, compression=compression, **kind, **layout)
            got = decode(data, memory=MEMORY)
            assert got.dtype == dtype
            np.testing.assert_array_equal(got, expected[:, :, :3])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize(
    ("extra", "kept"), [("unassalpha", 4), ("assocalpha", 3), ("unspecified", 3), (None, 3)]
)
def test_tiff_keeps_alpha_that_is_not_in_its_colours(
    dtype: str, compression: str | None, extra: str | None, kept: int
) -> None:
    pixels = noise((13, 17, 4), dtype)
    kind = {"photometric": "rgb", "compression": compression, "extrasamples": [extra or "unspecified"]}
    files = [bytearray(tiff(pixels, **kind))]
    if kept == 4 or dtype == "uint16":  # Pillow, which looks at files first, does not know the others
        files.append(bytearray(tiff(np.moveaxis(pixels, -1, 0), planarconfig="separate", **kind)))
    for data in files:
        if extra is None:  # without the tag, as some programs write it
            struct.pack_into("<H", data, data.index(struct.pack("<HHI", 338, 3, 1)), 65000)
        for alpha, channels in ((True, kept), (False, 3)):
            got = decode(bytes(data), memory=MEMORY, alpha=alpha)
            np.testing.assert_array_equal(got, pixels[:, :, :channels])


def test_palettes_are_looked_up() -> None:
    index = noise((9, 11), "uint8") % 16
    palette = noise((256, 3), "uint8")
    picture = Image.fromarray(index).convert("P")
    picture.putdata(index.ravel().tolist())
    picture.putpalette(palette.tobytes())
    expected = palette[index]
    np.testing.assert_array_equal(decode(saved(picture, "PNG"), memory=MEMORY), expected)
    clear = saved(picture, "PNG", transparency=bytes(range(16)))
    np.testing.assert_array_equal(decode(clear, memory=MEMORY), expected)
    colours = palette.T.astype(np.uint16) * 257
    data = tiff(index, photometric="palette", colormap=colours)
    np.testing.assert_array_equal(decode(data, memory=MEMORY), expected)


def test_black_and_white_is_read() -> None:
    bits = noise((10, 19), "uint8") > 99
    expected = np.where(bits, 255, 0)[..., None].repeat(3, axis=2)
    picture = Image.fromarray(bits)
    fax = saved(picture, "TIFF", compression="group4")
    for data in (saved(picture, "PNG"), saved(picture, "TIFF"), fax, tiff(bits, photometric="minisblack")):
        np.testing.assert_array_equal(decode(data, memory=MEMORY), expected)


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
def test_a_jpeg_is_read(mode: str) -> None:
    y, x = np.mgrid[:24, :32]
    smooth = np.stack([4 * x, 8 * y, 100 + 2 * x], axis=2).astype(np.uint8)
    picture = Image.fromarray(smooth).convert(mode)
    got = decode(saved(picture, "JPEG", quality=98, subsampling=0), memory=MEMORY)
    expected = np.asarray(picture if mode == "L" else picture.convert("RGB")).reshape(24, 32, -1)
    assert got.dtype == np.uint8
    np.testing.assert_allclose(got.astype(int), expected.astype(int), atol=6)


@pytest.mark.parametrize(("subsampling", "halved"), [("4:4:4", False), ("4:2:2", True), ("4:2:0", True)])
def test_colour_at_half_the_resolution_is_noticed(subsampling: str, halved: bool) -> None:
    pixels = noise((32, 48, 3), "uint8")
    picture = Image.fromarray(pixels)
    assert halves_colour(saved(picture, "JPEG", subsampling=subsampling)) == halved
    chroma = int(subsampling.replace(":", ""))
    assert halves_colour(heic(pixels, chroma=chroma, matrix_coefficients=1)) == halved
    for whole in (saved(picture.convert("L"), "JPEG"), saved(picture, "PNG"), tiff(pixels), b"no image"):
        assert not halves_colour(whole)
    assert not halves_colour(heic(pixels, chroma=420, matrix_coefficients=1)[:64])


def test_a_tiff_that_holds_a_jpeg_is_read() -> None:
    y, x = np.mgrid[:32, :32].astype(np.uint8)
    smooth = np.stack([4 * x, 7 * y, 100 + 2 * x], axis=2).astype(np.uint8)
    for data in (
        tiff(smooth, photometric="rgb", compression="jpeg"),
        saved(Image.fromarray(smooth), "TIFF", compression="jpeg"),
    ):
        np.testing.assert_allclose(decode(data, memory=MEMORY).astype(int), smooth.astype(int), atol=8)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"hello",
        bytes(100),
        b"\x89PNG\r\n\x1a\n",
        b"II*\0\x08\0\0\0",
        b"II*\0\xff\xff\xff\xff",
        b"\xff\xd8\xff\xe0",
        b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        saved(Image.new("RGB", (4, 4)), "GIF"),
        saved(Image.new("RGB", (4, 4)), "BMP"),
        saved(Image.new("RGB", (4, 4)), "WEBP"),
    ],
)
def test_file_that_is_no_image_is_refused(data: bytes) -> None:
    with pytest.raises(
        ImageError, match="not a PNG, TIFF, JPEG or HEIC image, or it is cut off: copy it again"
    ):
        decode(data, memory=MEMORY)


@pytest.mark.parametrize(
    "data",
    [
        claimed_png(60000, 60000),
        claimed_png(60000, 60000, depth=16),
        claimed_png(12000, 12000),
        claimed_png(12000, 12000, depth=16, colour=0),
        tiff(np.zeros((1200, 1200), np.uint8), compression="zlib"),
        tiff(np.zeros((800, 800, 3), np.uint16), compression="zlib", photometric="rgb"),
        saved(Image.new("L", (1100, 1100)), "JPEG"),
        saved(Image.new("P", (700, 700)), "PNG"),
    ],
)
def test_image_that_is_too_large_is_refused_by_its_header(data: bytes) -> None:
    start = time.process_time()
    with pytest.raises(ImageError, match=r"too large|takes more than") as caught:
        decode(data, memory=MEMORY)
    assert caught.value.fields == {"limit": MEMORY}
    assert time.process_time() - start < 1


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_the_limit_is_that_of_the_decoded_bytes(dtype: str, channels: int) -> None:
    pixels = noise((20, 30, channels), dtype)
    for data in (encode_png(pixels), tiff(pixels, photometric="rgb" if channels > 1 else "minisblack")):
        assert decode(data, memory=pixels.nbytes).shape == (20, 30, min(channels, 3))
        with pytest.raises(ImageError):
            decode(data, memory=pixels.nbytes - 1)


@pytest.mark.parametrize(
    "data",
    [
        tiff(np.ones((8, 8), np.float32)),
        tiff(np.ones((8, 8, 3), np.float16), photometric="rgb"),
        tiff(np.ones((8, 8), np.int16)),
        tiff(np.ones((8, 8), np.uint32)),
        tiff(np.ones((8, 8), np.complex64)),
        tiff(np.ones((4, 8, 8), np.uint8), volumetric=True, tile=(16, 16, 16), photometric="minisblack"),
        tiff(np.ones((8, 8, 7), np.uint8), photometric="minisblack", planarconfig="contig"),
        saved(
            Image.new("RGB", (4, 4)), "PNG", save_all=True, append_images=[Image.new("RGB", (4, 4), "red")]
        ),
    ],
)
def test_unsupported_variants_are_refused(data: bytes) -> None:
    with pytest.raises(ImageError):
        decode(data, memory=MEMORY)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("extra", [["unassalpha", "unspecified"], ["unspecified", "unassalpha"]])
def test_tiff_of_many_channels_is_refused_with_their_number(dtype: str, extra: list[str]) -> None:
    data = tiff(noise((8, 8, 5), dtype), photometric="rgb", extrasamples=extra)
    with pytest.raises(ImageError, match="this TIFF has 5 channels of"):
        decode(data, memory=MEMORY)


PIXELS = noise((40, 30, 3), "uint8")
VALID = {
    "png": encode_png(PIXELS),
    "png16": encode_png(noise((40, 30, 3), "uint16")),
    "palette": saved(Image.fromarray(PIXELS).quantize(16), "PNG", transparency=bytes(16)),
    "jpeg": saved(Image.fromarray(PIXELS), "JPEG"),
    "tiff": tiff(PIXELS, photometric="rgb"),
    "lzw": tiff(noise((40, 30), "uint16"), compression="lzw", rowsperstrip=9),
    "deflate": tiff(
        np.moveaxis(PIXELS, -1, 0), compression="zlib", photometric="rgb", planarconfig="separate"
    ),
    "tiled": tiff(PIXELS, compression="zstd", photometric="rgb", tile=(16, 16)),
    "jpeg in tiff": tiff(PIXELS, compression="jpeg", photometric="rgb"),
    "heic": heic(PIXELS),
}


def tried(data: bytes) -> NDArray[Any] | None:
    """What is decoded, None if it is refused; any other error fails the test."""
    start = time.process_time()
    try:
        got = decode(data, memory=MEMORY)
    except ImageError:
        got = None
    else:
        assert got.ndim == 3
        assert got.shape[2] in (1, 3)
        assert got.nbytes <= MEMORY
        assert got.dtype in (np.uint8, np.uint16)
    assert time.process_time() - start < 5
    return got


@pytest.mark.parametrize("kind", VALID)
def test_a_truncated_file_is_never_read_as_something_else(kind: str) -> None:
    data = VALID[kind]
    whole = decode(data, memory=MEMORY)
    refused = 0
    lengths = np.linspace(0, len(data) - 1, 40).astype(int)
    for length in lengths:
        got = tried(data[:length])
        refused += got is None
        # The last bytes of some formats are not needed.
        assert got is None or (length > 0.95 * len(data) and np.mean(got != whole) < 0.05)
    assert refused > 0.9 * len(lengths)


@pytest.mark.parametrize("kind", VALID)
def test_a_damaged_file_is_an_image_error_or_an_image(kind: str) -> None:
    rng = np.random.default_rng(len(kind))
    for case in range(60):
        data = bytearray(VALID[kind])
        # Half of the cases hit the headers, where the sizes stand.
        reach = min(len(data), 200) if case % 2 else len(data)
        for at in rng.integers(0, reach, rng.integers(1, 8)):
            data[at] = rng.integers(256)
        if case % 5 == 0:
            del data[int(rng.integers(len(data))) :]
        tried(bytes(data))


@pytest.mark.parametrize("kind", ["tiff", "lzw", "deflate", "jpeg in tiff"])
def test_tiff_with_false_tags_is_an_image_error_or_an_image(kind: str) -> None:
    (first,) = struct.unpack_from("<I", VALID[kind], 4)
    (tags,) = struct.unpack_from("<H", VALID[kind], first)
    for tag in range(tags):
        for value in (0, 1, 255, 65535, 0x7FFFFFFF, 0xFFFFFFFF):
            for at in (4, 8):  # the count of its values, and the value or where it stands
                data = bytearray(VALID[kind])
                struct.pack_into("<I", data, first + 2 + 12 * tag + at, value)
                tried(bytes(data))


def test_jpeg_in_a_tiff_with_a_false_size_takes_no_memory() -> None:
    data = bytearray(VALID["jpeg in tiff"])
    struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, 20000, 20000)
    tracemalloc.start()
    try:
        tried(bytes(data))
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("compression", ["zlib", "jpeg"])
def test_tiles_much_larger_than_the_image_are_refused(compression: str) -> None:
    target = io.BytesIO()
    pixels = np.zeros((16, 16, 3), np.uint8)
    tifffile.imwrite(target, pixels, photometric="rgb", tile=(16, 16), compression=compression)
    data = bytearray(target.getvalue())
    width = data.index(struct.pack("<HHII", 322, 4, 1, 16))  # TileWidth
    decode(bytes(data), memory=MEMORY)
    struct.pack_into("<I", data, width + 8, 1 << 24)
    with pytest.raises(ImageError, match="tiles of 16777216 x 16 pixels") as caught:
        decode(bytes(data), memory=MEMORY)
    assert caught.value.fields == {"limit": MEMORY}


def test_a_jpeg_of_many_scans_is_refused() -> None:
    target = io.BytesIO()
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(target, "JPEG", progressive=True)
    data = target.getvalue()
    decode(data, memory=MEMORY)
    scan = data[data.rindex(b"\xff\xda") : -2]
    with pytest.raises(ImageError, match="100 scans"):
        decode(data[:-2] + scan * 100 + data[-2:], memory=MEMORY)


def test_film_behind_a_jpeg_is_not_taken_for_scans() -> None:
    """Phones append what they filmed before the picture: in ten megabytes some bytes look like scans."""
    pixels = np.random.default_rng(3).integers(0, 256, (64, 64, 3), np.uint8)
    still = encode_jpeg(pixels, 95)
    np.testing.assert_array_equal(
        decode(still + b"mpv2" + b"\xff\xda" * 101, memory=MEMORY), decode(still, memory=MEMORY)
    )


def test_units_and_integers() -> None:
    for dtype in ("uint8", "uint16"):
        codes = np.arange(np.iinfo(dtype).max + 1).astype(dtype).reshape(1, -1, 1)
        unit = to_unit(codes)
        assert unit.dtype == np.float32
        assert (unit.min(), unit.max()) == (0, 1)
        np.testing.assert_array_equal(to_integers(unit, np.dtype(dtype)), codes)
    outside = np.array([-1, 0.4999, 2], np.float32)
    np.testing.assert_array_equal(to_integers(outside, np.dtype("uint8")), [0, 127, 255])
