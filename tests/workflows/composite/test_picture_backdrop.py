"""Files of pictures to the light of a backdrop."""

import io
import struct
import zlib

import imagecodecs
import numpy as np
import pytest
from PIL import Image, ImageCms

from storage.errors import ImageError
from workflows.composite.backdrop import backdrop_of, node_light
from workflows.images import decode, float_formats, integer_formats
from workflows.images.tone_curves import to_light

MEMORY = 1 << 24


def saved(picture: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    target = io.BytesIO()
    picture.save(target, kind, **options)
    return target.getvalue()


def light(data: bytes, transfer: str = "srgb") -> np.ndarray:
    """What cells see that are as large as the pixels."""
    pixels = decode.decode(data, transfer, memory=MEMORY)
    height, width, _ = pixels.shape
    return node_light(backdrop_of(pixels, transfer), width, height, 1)[: height * width].reshape(
        height, width, 3
    )


@pytest.fixture
def codes() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)


def test_integers_are_encoded_as_asked(codes: np.ndarray) -> None:
    data = integer_formats.encode_png(codes)
    unit = integer_formats.to_unit(codes)
    np.testing.assert_allclose(light(data), to_light(unit, "srgb"), rtol=1e-6)
    np.testing.assert_allclose(light(data, "linear"), unit, rtol=1e-6)


def test_float_values_are_light_and_what_is_no_number_is_black() -> None:
    picture = np.array([[[0.5, 2, 4], [np.nan, np.inf, -np.inf]]], np.float32)
    assert light(float_formats.encode_exr({"RGB": picture})).tolist() == [[[0.5, 2, 4], [0, 0, 0]]]


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_what_is_transparent_is_black_in_proportion(codes: np.ndarray, depth: type) -> None:
    top = np.iinfo(depth).max
    deep = (codes.astype(np.uint32) * (top // 255)).astype(depth)
    alpha = np.full((5, 7, 1), top, depth)
    opaque = light(integer_formats.encode_png(np.concatenate([deep, alpha], axis=2)))
    np.testing.assert_array_equal(opaque, light(integer_formats.encode_png(deep)))
    alpha[0], alpha[1] = 0, top // 5
    seen = light(integer_formats.encode_png(np.concatenate([deep, alpha], axis=2)))
    assert (seen[0] == 0).all()
    np.testing.assert_allclose(seen[1], opaque[1] / 5, rtol=1e-3)
    np.testing.assert_array_equal(seen[2:], opaque[2:])


@pytest.mark.parametrize("mode", ["P", "L", "LA", "CMYK", "1"])
def test_other_kinds_of_pictures(codes: np.ndarray, mode: str) -> None:
    picture = Image.fromarray(codes).convert(mode)
    seen = light(saved(picture, "TIFF" if mode == "CMYK" else "PNG"))
    expected = to_light(np.asarray(picture.convert("RGB"), np.float32) / np.float32(255), "srgb")
    np.testing.assert_allclose(np.broadcast_to(seen, expected.shape), expected, atol=1e-6)


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_a_colour_profile_is_converted(codes: np.ndarray, depth: type) -> None:
    wide = imagecodecs.cms_profile("adobergb")
    deep = codes if depth is np.uint8 else codes.astype(np.uint16) * 257
    data = saved(Image.fromarray(codes), icc_profile=wide) if depth is np.uint8 else _png16(deep, wide)
    seen = light(data)
    srgb = ImageCms.createProfile("sRGB")
    expected = ImageCms.profileToProfile(
        Image.fromarray(codes), ImageCms.getOpenProfile(io.BytesIO(wide)), srgb
    )
    np.testing.assert_allclose(seen, to_light(np.asarray(expected, np.float32) / 255, "srgb"), atol=0.01)
    # values that are light are no colours of a profile
    np.testing.assert_allclose(light(data, "linear"), integer_formats.to_unit(codes), atol=1e-6)


def _png16(codes: np.ndarray, profile: bytes) -> bytes:
    """A PNG of 16 bits with an iCCP chunk (PNG, sect. 11.3.2.3)."""
    plain = integer_formats.encode_png(codes)
    body = b"iCCP" + b"wide\0\0" + zlib.compress(profile)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return plain[:33] + chunk + plain[33:]  # after IHDR


def test_a_colour_profile_that_is_none_is_refused(codes: np.ndarray) -> None:
    with pytest.raises(ImageError, match="colour profile"):
        light(saved(Image.fromarray(codes), icc_profile=b"no profile" * 20))


def test_one_that_is_too_large_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(ImageError, match="takes more than"):
        light(saved(Image.new("RGB", (6000, 4000))))
