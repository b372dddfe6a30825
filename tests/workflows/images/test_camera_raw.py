"""Camera RAW: DNGs made here, with known counts, by LibRaw to linear light."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from tests.workflows.images.test_raw_files import nef
from workflows.images import decode as any_format
from workflows.images.camera_raw import decode, develop

MEMORY = 1 << 20
BLACK, WHITE = 256, 4095
COUNTS = np.random.default_rng(8).integers(200, 4000, (40, 60), np.uint16)
XTRANS = "GBGGRG RGRBGB GBGGRG GRGGBG BGBRGR GRGGBG"
"""Fuji's filter, by rows."""
COLOURS = np.array([[*row] for row in XTRANS.split()])
Dng = Callable[..., bytes]


def expected(counts: NDArray[Any]) -> NDArray[Any]:
    light = (counts.astype(np.float32) - BLACK) / (WHITE - BLACK)
    red, blue = light[::2, ::2], light[1::2, 1::2]
    return np.stack([red, (light[::2, 1::2] + light[1::2, ::2]) / 2, blue], axis=2)


def test_a_dng_is_linear_light_at_half_its_size(make_dng: Dng) -> None:
    light = decode(make_dng(COUNTS, BLACK, WHITE), memory=MEMORY)
    assert light.shape == (20, 30, 3)
    assert light.dtype == np.float32
    assert light.min() < 0  # below the black level, by noise
    np.testing.assert_allclose(light, expected(COUNTS), atol=1e-6)


def test_an_odd_edge_is_left_out(make_dng: Dng) -> None:
    light = decode(make_dng(COUNTS[:39, :59], BLACK, WHITE), memory=MEMORY)
    np.testing.assert_allclose(light, expected(COUNTS)[:19, :29], atol=1e-6)


def test_a_pixel_with_a_clipped_element_is_clipped(make_dng: Dng) -> None:
    counts = COUNTS.copy()
    counts[4, 6], counts[9, 12] = WHITE, WHITE - 10  # red of pixel (2, 3), green of (4, 6)
    light = decode(make_dng(counts, BLACK, WHITE), memory=MEMORY)
    assert np.isinf(light[2, 3, 0])
    assert np.isinf(light[4, 6, 1])
    assert np.isinf(light).sum() == 2


def test_the_limit_is_checked_before_unpacking(make_dng: Dng) -> None:
    data = make_dng(COUNTS, BLACK, WHITE)
    decode(data, memory=20 * 30 * 12)
    with pytest.raises(ImageError, match="60 x 40 photosites takes more than the 7199 bytes") as caught:
        decode(data, memory=20 * 30 * 12 - 1)
    assert caught.value.fields == {"limit": 20 * 30 * 12 - 1}


def plain_tiff() -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, np.ones((30, 30, 3), np.uint8), photometric="rgb", compression="zlib")
    return target.getvalue()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "cut off or damaged"),
        (bytes(5000), "RAW format is not supported: convert it to DNG"),
        (b"FUJIFILMCCD-RAW " + bytes(5000), "RAW"),
        (plain_tiff(), "RAW"),
        (b"\xff\xd8\xff\xe0" + bytes(5000), "JPEG with the name of camera RAW: rename it to .jpg"),
    ],
)
def test_raw_unknown_to_libraw_is_refused(data: bytes, why: str) -> None:
    with pytest.raises(ImageError, match=why):
        decode(data, memory=MEMORY)


def test_colour_filter_may_have_another_order(make_dng: Dng) -> None:
    light = decode(make_dng(COUNTS, BLACK, WHITE, pattern=(2, 1, 1, 0)), memory=MEMORY)
    np.testing.assert_allclose(light, expected(COUNTS)[:, :, ::-1], atol=1e-6)


def test_another_colour_filter_is_refused(make_dng: Dng) -> None:
    with pytest.raises(ImageError, match="RAW"):
        decode(make_dng(COUNTS, BLACK, WHITE, pattern=(0, 1, 1, 1)), memory=MEMORY)


@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3)])
@pytest.mark.parametrize(
    "how", [{}, {"compression": "jpeg", "compressionargs": {"lossless": True}, "tile": (16, 16)}]
)
def test_a_truncated_dng_is_refused(make_dng: Dng, shape: tuple[int, ...], how: dict[str, Any]) -> None:
    counts = np.random.default_rng(8).integers(200, 4000, shape, np.uint16)
    data = make_dng(counts, BLACK, WHITE, **how)
    for length in np.linspace(0, len(data) - 9, 20).astype(int):
        with pytest.raises(ImageError):
            decode(data[:length], memory=MEMORY)


def numbered(colours: NDArray[Any]) -> tuple[int, ...]:
    """A filter as DNG has it."""
    return tuple("RGB".index(colour) for colour in colours.ravel())


@pytest.mark.parametrize(("down", "right"), [(0, 0), (1, 0), (2, 1), (4, 5)])
def test_xtrans_is_linear_light_at_a_third_of_its_size(make_dng: Dng, down: int, right: int) -> None:
    turned = np.roll(COLOURS, (-down, -right), (0, 1))
    light = decode(make_dng(COUNTS, BLACK, WHITE, pattern=numbered(turned)), memory=MEMORY)
    top, left = -down % 3, -right % 3
    assert light.shape == ((40 - top) // 3, (60 - left) // 3, 3)
    of_element = (COUNTS.astype(np.float32) - BLACK) / (WHITE - BLACK)
    for row, column in np.ndindex(light.shape[:2]):
        at = slice(top + 3 * row, top + 3 * row + 3), slice(left + 3 * column, left + 3 * column + 3)
        colours = np.tile(turned, (8, 12))[at]
        means = [of_element[at][colours == colour].mean() for colour in "RGB"]
        assert [int((colours == colour).sum()) for colour in "RGB"] == [2, 5, 2]
        np.testing.assert_allclose(light[row, column], means, atol=1e-6)


def test_a_clipped_element_of_xtrans_clips_its_colour_of_its_pixel(make_dng: Dng) -> None:
    counts = COUNTS.copy()
    counts[4, 7] = WHITE  # the centre of a block
    light = decode(make_dng(counts, BLACK, WHITE, pattern=numbered(COLOURS)), memory=MEMORY)
    assert np.argwhere(np.isinf(light)).tolist() == [[1, 2, 1]]


@pytest.mark.parametrize("pattern", [(0, 1, 1, 2), numbered(COLOURS)])
def test_the_margin_is_cut_off(make_dng: Dng, pattern: tuple[int, ...]) -> None:
    # By DNG, the filter begins at the active area; 8 and 10 are no multiple of 3 or 6.
    framed = np.zeros((50, 74), np.uint16)
    framed[8:48, 10:70] = COUNTS
    got = decode(make_dng(framed, BLACK, WHITE, pattern, active=(8, 10, 48, 70)), memory=MEMORY)
    np.testing.assert_array_equal(got, decode(make_dng(COUNTS, BLACK, WHITE, pattern), memory=MEMORY))


def test_a_filter_of_36_that_is_not_xtrans_is_refused(make_dng: Dng) -> None:
    other = np.array([[*"RGBRGB"]] * 6)
    with pytest.raises(ImageError, match="not that of an X-Trans"):
        decode(make_dng(COUNTS, BLACK, WHITE, pattern=numbered(other)), memory=MEMORY)


PIXELS = np.random.default_rng(9).integers(200, 4000, (40, 60, 3), np.uint16)


@pytest.mark.parametrize(
    "how",
    [{}, {"compression": "jpeg", "compressionargs": {"lossless": True}, "tile": (16, 16)}],
    ids=["plain", "lossless JPEG in tiles"],
)
def test_a_linear_dng_is_read_pixel_by_pixel(make_dng: Dng, how: dict[str, Any]) -> None:
    pixels = PIXELS.copy()
    pixels[3, 5, 1] = WHITE
    light = decode(make_dng(pixels, BLACK, WHITE, **how), memory=MEMORY)
    assert light.dtype == np.float32
    assert np.argwhere(np.isinf(light)).tolist() == [[3, 5, 1]]
    light[3, 5, 1] = 1
    np.testing.assert_allclose(light, (pixels.astype(np.float32) - BLACK) / (WHITE - BLACK), atol=1e-6)


def test_a_linear_dngs_margin_is_cut_off_and_its_limit_checked_first(make_dng: Dng) -> None:
    data = make_dng(PIXELS, BLACK, WHITE, active=(4, 6, 38, 56))
    assert decode(data, memory=40 * 60 * 12).shape == (34, 50, 3)
    with pytest.raises(ImageError, match="60 x 40 linear pixels"):
        decode(data, memory=40 * 60 * 12 - 1)


@pytest.mark.parametrize("shape", [(40, 60), (40, 60, 3)])
def test_a_dng_of_floats_is_refused(make_dng: Dng, shape: tuple[int, ...]) -> None:
    with pytest.raises(ImageError, match="EXR or float TIFF"):
        decode(make_dng(np.ones(shape, np.float32), 0, 1), memory=MEMORY)


def test_dng_in_a_compression_unknown_to_libraw_is_refused(make_dng: Dng) -> None:
    data = make_dng(PIXELS, BLACK, WHITE, compression=tifffile.COMPRESSION.JPEGXL_DNG)
    with pytest.raises(ImageError, match="other than JPEG XL"):
        decode(data, memory=MEMORY)


def test_a_developed_picture_has_the_cameras_white_balance_and_white_highlights(make_dng: Dng) -> None:
    neutral = 50, 100, 80
    counts = np.full((40, 60), BLACK, np.uint16)
    at = (
        (slice(0, None, 2), slice(0, None, 2)),
        (slice(None), slice(None)),
        (slice(1, None, 2), slice(1, None, 2)),
    )
    light = 0.25
    for share, (y, x) in zip((neutral[1], neutral[0], neutral[2]), (at[1], at[0], at[2]), strict=True):
        counts[y, x] = BLACK + round(light * share / 100 * (WHITE - BLACK))
    counts[:4, :4] = WHITE
    data = make_dng(counts, BLACK, WHITE, neutral=neutral)
    picture = develop(data, memory=MEMORY)
    assert picture.shape == (20, 30, 3)
    np.testing.assert_allclose(picture[:2, :2], 1, atol=1e-5)
    np.testing.assert_allclose(picture[3:], light, atol=1e-3)
    # A frame holds what the camera saw.
    np.testing.assert_allclose(decode(data, memory=MEMORY)[5, 5], np.array(neutral) / 100 * light, atol=1e-3)


def test_a_developed_picture_has_the_primaries_of_srgb(make_dng: Dng) -> None:
    counts = np.full((40, 60), 1600, np.uint16)
    grey = develop(make_dng(counts, BLACK, WHITE), memory=MEMORY)[4, 4]
    counts[::2, ::2] = 1900  # more of the first colour, of a camera that sees XYZ, as its matrix says
    red = develop(make_dng(counts, BLACK, WHITE), memory=MEMORY)[4, 4] - grey
    # The first column of the matrix from XYZ to sRGB (IEC 61966-2-1).
    np.testing.assert_allclose(red / red[0], [1, -0.299, 0.017], atol=0.01)


def test_a_backdrop_is_the_raw_and_not_its_thumbnail(make_dng: Dng) -> None:
    data = make_dng(COUNTS, BLACK, WHITE, orientation=6, thumbnail=np.zeros((8, 12, 3), np.uint8))
    expected = develop(data, memory=MEMORY)
    assert expected.shape == (30, 20, 3)
    for transfer in ("srgb", "linear"):
        np.testing.assert_array_equal(any_format.decode(data, transfer, memory=MEMORY), expected)
    with pytest.raises(
        ImageError, match=r"^the RAW image is cut off or damaged: copy it again from the camera$"
    ):
        any_format.decode(data[: len(data) // 2], "srgb", memory=MEMORY)


def test_a_backdrop_of_nikons_is_not_its_thumbnail() -> None:
    assert any_format.decode(nef(), "srgb", memory=MEMORY).shape == (20, 30, 3)
