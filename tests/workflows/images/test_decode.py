"""Pictures of every format are decoded upright, as their orientation says."""

import io
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps

from storage.errors import ImageError
from storage.layout.captures import Stack
from workflows.images import camera_raw, decode, float_formats, integer_formats
from workflows.images.tone_curves import to_light

MEMORY = 1 << 20
TAG = 274
PIXELS = np.random.default_rng(4).integers(0, 256, (6, 9, 3), np.uint8)
DEEP = PIXELS.astype(np.uint16) * 257
Zip = Callable[..., bytes]
Ingest = Callable[..., Stack]


def shown(pixels: NDArray[Any], turn: int) -> NDArray[Any]:
    """The first channels of pixels as Pillow turns them."""
    picture = Image.fromarray(pixels)
    picture.getexif()[TAG] = turn
    return np.asarray(ImageOps.exif_transpose(picture))


def saved(kind: str, turn: int, pixels: NDArray[Any] = PIXELS, **options: Any) -> bytes:
    exif = Image.Exif()
    exif[TAG] = turn
    target = io.BytesIO()
    Image.fromarray(pixels).save(target, kind, exif=exif, **options)
    return target.getvalue()


def tiff(turn: int, pixels: NDArray[Any]) -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, photometric="rgb", extratags=[(TAG, "H", 1, turn, True)])
    return target.getvalue()


@pytest.mark.parametrize("turn", range(1, 9))
def test_every_orientation_of_every_kind(turn: int) -> None:
    expected = shown(PIXELS, turn)
    for data in (saved("PNG", turn), tiff(turn, PIXELS), saved("TIFF", turn, compression="tiff_lzw")):
        assert integer_formats.orientation(data) == turn
        np.testing.assert_array_equal(integer_formats.decode(data, memory=MEMORY), expected)
        np.testing.assert_array_equal(integer_formats.decode(data, memory=MEMORY, turn=1), PIXELS)
    np.testing.assert_array_equal(integer_formats.decode(tiff(turn, DEEP), memory=MEMORY) // 257, expected)
    np.testing.assert_array_equal(
        float_formats.decode(tiff(turn, PIXELS.astype(np.float32)), memory=MEMORY), expected
    )
    # The latter Pillow turns itself.
    for data in (saved("JPEG", turn), saved("TIFF", turn, compression="jpeg")):
        plain = integer_formats.decode(data, memory=MEMORY, turn=1)
        assert plain.shape == PIXELS.shape
        np.testing.assert_array_equal(integer_formats.decode(data, memory=MEMORY), shown(plain, turn))


def test_a_backdrop_is_upright_with_its_profile_and_its_transparency() -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    found = decode.decode(saved("JPEG", 6, icc_profile=profile), "srgb", memory=MEMORY)
    assert found.shape == (9, 6, 3)
    seen = np.dstack([PIXELS, PIXELS[..., :1]])
    found = decode.decode(saved("PNG", 3, seen), "srgb", memory=MEMORY)
    np.testing.assert_array_equal(found, seen[::-1, ::-1])


def with_chunks(png: bytes, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG with more chunks, after its header."""
    made = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    return png[:33] + b"".join(made) + png[33:]


LINEAR = b"gAMA", struct.pack(">I", 100_000)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("gamma", [1.0, 1 / 1.8])
def test_a_png_of_another_gamma_is_converted_to_srgb(channels: int, gamma: float) -> None:
    light = np.random.default_rng(1).random((6, 9, channels), np.float32)
    png = integer_formats.encode_png(np.rint(light**gamma * 65535).astype(np.uint16))
    marked = with_chunks(png, (b"gAMA", struct.pack(">I", round(gamma * 100_000))))
    found = integer_formats.to_unit(decode.decode(marked, "srgb", memory=MEMORY))
    colours = 3 if channels >= 3 else 1
    np.testing.assert_allclose(to_light(found[..., :colours], "srgb"), light[..., :colours], atol=1e-4)
    np.testing.assert_allclose(found[..., colours:], light[..., colours:] ** gamma, atol=1e-4)
    as_it_is = decode.decode(marked, "linear", memory=MEMORY)
    np.testing.assert_array_equal(as_it_is, decode.decode(png, "linear", memory=MEMORY))


@pytest.mark.parametrize(
    "chunks",
    [
        [(b"gAMA", struct.pack(">I", 45455))],
        [(b"gAMA", struct.pack(">I", 0))],
        [LINEAR, (b"sRGB", b"\0")],
        [LINEAR, (b"cICP", bytes((1, 13, 0, 1)))],
        [
            LINEAR,
            (
                b"iCCP",
                b"x\0\0" + zlib.compress(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()),
            ),
        ],
    ],
    ids=["2.2", "none", "sRGB", "cICP", "iCCP"],
)
def test_the_gamma_of_srgb_and_what_comes_before_gamma(chunks: list[tuple[bytes, bytes]]) -> None:
    found = decode.decode(with_chunks(saved("PNG", 1), *chunks), "srgb", memory=MEMORY)
    np.testing.assert_allclose(found, PIXELS, atol=1)  # a conversion from sRGB to sRGB rounds


@pytest.mark.parametrize("turn", [0, 9, 65535])
def test_invalid_orientation_is_ignored(turn: int) -> None:
    for data in (saved("JPEG", turn), tiff(turn, PIXELS)):
        assert integer_formats.orientation(data) == 1
        assert integer_formats.decode(data, memory=MEMORY).shape == PIXELS.shape
    assert integer_formats.orientation(b"no picture") == camera_raw.orientation(b"no picture") == 1


def test_the_limit_of_memory_comes_before_the_orientation() -> None:
    with pytest.raises(integer_formats.ImageError, match="takes more"):
        integer_formats.decode(saved("PNG", 6, np.zeros((600, 900, 3), np.uint8)), memory=MEMORY)


@pytest.mark.parametrize(("turn", "quarters"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_camera_raw(make_dng: Callable[..., bytes], turn: int, quarters: int) -> None:
    counts = np.random.default_rng(8).integers(300, 4000, (40, 60), np.uint16)
    data = make_dng(counts, 256, 4095, orientation=turn)
    assert camera_raw.orientation(data) == turn
    upright = camera_raw.decode(data, memory=MEMORY)
    np.testing.assert_array_equal(upright, np.rot90(camera_raw.decode(data, memory=MEMORY, turn=1), quarters))


ACES = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
"""The primaries AP1 and the white of ACEScg."""


def exr_of(light: NDArray[np.float32], chromaticities: tuple[float, ...] | None = None) -> bytes:
    """An EXR that OpenImageIO writes."""
    height, width, channels = light.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.FLOAT)
    if chromaticities:
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), chromaticities)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "light.exr")
        image = oiio.ImageBuf(spec)
        image.set_pixels(oiio.ROI(), light)
        assert image.write(str(path)), image.geterror()
        return path.read_bytes()


def test_light_in_acescg_is_that_in_rec_709() -> None:
    """OpenImageIO, by OpenColorIO, converts a picture to ACEScg; its chromaticities lead back."""
    light = np.random.default_rng(2).random((5, 7, 3)).astype(np.float32)
    light[0, 0] = 1
    converted = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(light), "Linear Rec.709 (sRGB)", "ACEScg")
    assert not converted.has_error, converted.geterror()
    aces = converted.get_pixels(oiio.FLOAT)
    assert np.abs(aces - light).max() > 0.1
    found = decode.decode(exr_of(aces, ACES), "srgb", memory=MEMORY)
    np.testing.assert_allclose(found, light, atol=2e-4)
    as_it_is = decode.decode(exr_of(aces), "srgb", memory=MEMORY)
    np.testing.assert_array_equal(as_it_is, aces)


def test_a_sun_that_overflows_is_bright_in_acescg_too() -> None:
    light = np.full((5, 7, 3), 0.5, np.float32)
    light[1, 2] = np.inf
    found = decode.decode(exr_of(light, ACES), "srgb", memory=MEMORY)
    np.testing.assert_allclose(found[1, 2], decode.MOST_LIGHT, rtol=1e-3)
    np.testing.assert_allclose(found[0, 0], 0.5, rtol=1e-3)


def test_nan_is_refused_by_its_first_pixel() -> None:
    light = np.ones((5, 7, 3), np.float32)
    light[4, 1] = light[3, 6, 2] = np.nan
    message = r"no number \(NaN\) in 2 of its pixels, first at x = 6, y = 3: replace them"
    with pytest.raises(ImageError, match=message):
        decode.decode(float_formats.encode_exr("RGB", light), "srgb", memory=MEMORY)


def test_rec_709_and_grey_are_left_as_they_are() -> None:
    light = np.random.default_rng(2).random((5, 7, 3)).astype(np.float32)
    named = exr_of(light, tuple(float_formats.REC_709.tolist()))
    np.testing.assert_array_equal(decode.decode(named, "srgb", memory=MEMORY), light)
    grey = light[..., :1].copy()
    found = decode.decode(float_formats.encode_exr("Y", grey), "srgb", memory=MEMORY)
    np.testing.assert_array_equal(found, grey)


@pytest.mark.parametrize(
    "wrong", [(0.0,) * 8, (0.3,) * 8, (np.nan,) * 8, (0.64, 0.33, 0.64, 0.33, 0.15, 0.06, 0.3127, 0.329)]
)
def test_impossible_chromaticities_are_refused(wrong: tuple[float, ...]) -> None:
    light = np.ones((5, 7, 3), np.float32)
    with pytest.raises(ImageError, match="no light has the chromaticities"):
        decode.decode(exr_of(light, wrong), "srgb", memory=MEMORY)


def test_composites_say_their_primaries(tmp_path: Path) -> None:
    path = tmp_path / "composite.exr"
    path.write_bytes(float_formats.encode_exr("RGBA", np.ones((5, 7, 4), np.float32)))
    spec = oiio.ImageBuf(str(path)).spec()
    np.testing.assert_allclose(spec.getattribute("chromaticities"), float_formats.REC_709, rtol=1e-6)
