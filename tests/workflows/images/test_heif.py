"""HEIC: the pixels, colours and orientation of files made here, and nothing but ImageError from others."""

import struct
from typing import Any

import imagecodecs
import numpy as np
import pillow_heif
import pytest
from numpy.typing import NDArray

from storage.errors import ImageError
from tests.parts.inputs.heics import heic
from workflows.images import decode as any_format
from workflows.images import hdr, heif, integer_formats
from workflows.images.orientation import upright
from workflows.images.tone_curves import to_light

MEMORY = 1 << 20
PIXELS = np.random.default_rng(4).integers(0, 256, (70, 90, 3), np.uint8)
P3 = [0.680, 0.320, 0.265, 0.690, 0.150, 0.060]
"""The primaries of Display P3, x and y of each."""


def bits_of(bits: int) -> NDArray[np.uint16]:
    pixels = np.random.default_rng(4).integers(0, 1 << bits, (64, 66, 3), np.uint16)
    pixels[0, :2] = [[0] * 3, [(1 << bits) - 1] * 3]
    return pixels


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_eight_bits_are_read_exactly(channels: int) -> None:
    pixels = np.dstack([PIXELS, PIXELS[..., :1]])[..., :channels]
    data = heic(pixels)
    assert heif.is_heif(data)
    np.testing.assert_array_equal(heif.decode(data, memory=MEMORY), pixels)
    np.testing.assert_array_equal(integer_formats.decode(data, memory=MEMORY), pixels[..., :3])
    np.testing.assert_array_equal(any_format.decode(data, "srgb", memory=MEMORY), pixels)


@pytest.mark.parametrize("bits", [10, 12])
def test_more_bits_are_stretched_to_sixteen(bits: int) -> None:
    pixels = bits_of(bits)
    got = heif.decode(heic(pixels, bits=bits, save_to_12bit=bits == 12), memory=MEMORY)
    assert got.dtype == np.uint16
    assert got[0, :2].tolist() == [[0] * 3, [65535] * 3]  # to the end of the scale: clipped
    np.testing.assert_array_equal(got >> (16 - bits), pixels)


@pytest.mark.parametrize("turn", range(1, 9))
def test_every_orientation(turn: int) -> None:
    data = heic(PIXELS, turn)
    assert integer_formats.orientation(data) == turn
    np.testing.assert_array_equal(integer_formats.decode(data, memory=MEMORY), upright(PIXELS, turn))
    # A camera that looks down states any orientation: all frames are turned as the first.
    for first in (1, turn, 6):
        np.testing.assert_array_equal(
            integer_formats.decode(data, memory=MEMORY, turn=first), upright(PIXELS, first)
        )


def test_colours_of_a_wide_gamut_become_srgb_however_they_are_stated() -> None:
    curve = to_light(np.linspace(0, 1, 4096, dtype=np.float32), "srgb")
    profile = imagecodecs.cms_profile("rgb", whitepoint=[0.3127, 0.329], primaries=P3, transferfunction=curve)
    expected = imagecodecs.cms_transform(
        PIXELS, profile, imagecodecs.cms_profile("srgb"), colorspace="rgb", outcolorspace="rgb"
    )
    assert np.abs(expected.astype(int) - PIXELS).max() > 20
    embedded = heic(PIXELS, icc_profile=profile, icc_profile_type="prof")
    stated = heic(PIXELS, color_primaries=12, transfer_characteristics=13)
    for data in (embedded, stated):
        got = any_format.decode(data, "srgb", memory=MEMORY)
        assert np.abs(got.astype(int) - expected).max() <= 1
        np.testing.assert_array_equal(any_format.decode(data, "linear", memory=MEMORY), PIXELS)
    srgb = heic(PIXELS, color_primaries=1, transfer_characteristics=13)
    np.testing.assert_array_equal(any_format.decode(srgb, "srgb", memory=MEMORY), PIXELS)


@pytest.mark.parametrize("transfer", [hdr.PQ, hdr.HLG])
@pytest.mark.parametrize("bits", [8, 10])
def test_hdr_becomes_srgb(transfer: int, bits: int) -> None:
    pixels = PIXELS if bits == 8 else bits_of(bits)
    stated = {"color_primaries": hdr.BT_2020, "transfer_characteristics": transfer}
    plain = heif.decode(heic(pixels), memory=MEMORY)
    full = (plain * np.uint16(257) if bits == 8 else plain).astype(np.uint16)
    expected = hdr.to_srgb(full, transfer, hdr.BT_2020)
    data = heic(pixels, **stated)
    np.testing.assert_array_equal(heif.decode(data, memory=MEMORY), expected)
    np.testing.assert_array_equal(any_format.decode(data, "srgb", memory=MEMORY), expected)


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("channels", [1, 4])
def test_grey_and_colours_beside_alpha_become_srgb_too(channels: int, bits: int) -> None:
    pixels = PIXELS if bits == 8 else bits_of(bits)
    pixels = np.dstack([pixels, pixels[..., :1]])[..., :channels]
    plain = heif.decode(heic(pixels), memory=MEMORY)
    full = (plain * np.uint16(257) if bits == 8 else plain).astype(np.uint16)
    expected = np.dstack([hdr.to_srgb(full[..., :3], hdr.PQ, hdr.BT_2020), full[..., 3:]])
    data = heic(pixels, color_primaries=hdr.BT_2020, transfer_characteristics=hdr.PQ)
    np.testing.assert_array_equal(heif.decode(data, memory=MEMORY), expected)


@pytest.mark.parametrize("pixels", [PIXELS, bits_of(10)])
def test_the_limit_is_that_of_the_decoded_bytes(pixels: NDArray[Any]) -> None:
    data = heic(pixels)
    heif.decode(data, memory=pixels.nbytes)
    with pytest.raises(ImageError, match="takes more than") as caught:
        heif.decode(data, memory=pixels.nbytes - 1)
    assert caught.value.fields == {"limit": pixels.nbytes - 1}


def test_picture_larger_than_its_header_says_is_never_decoded() -> None:
    data = bytearray(heic(np.zeros((1200, 1600, 3), np.uint8)))
    at = data.index(b"ispe") + 8
    assert struct.unpack_from(">II", data, at) == (1600, 1200)
    struct.pack_into(">II", data, at, 64, 64)
    with pytest.raises(ImageError):
        heif.decode(bytes(data), memory=MEMORY)


def test_a_truncated_file_is_refused_with_a_remedy() -> None:
    data = heic(PIXELS)
    for length in np.linspace(12, len(data) - 1, 30).astype(int):
        with pytest.raises(ImageError, match="is cut off or damaged: copy it again from the camera"):
            heif.decode(data[:length], memory=MEMORY)
        heif.orientation(data[:length])


def test_lack_of_memory_is_not_taken_for_damage(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("Out of memory")

    data = heic(PIXELS)
    monkeypatch.setattr(pillow_heif, "open_heif", fail)
    with pytest.raises(ImageError) as caught:
        heif.decode(data, memory=MEMORY)
    assert isinstance(caught.value.__cause__, MemoryError)
