"""Backdrops from pictures, and their light at the nodes of T, compared with numpy."""

import io
import struct
import zlib

import imagecodecs
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms

from storage.errors import ImageError
from tests.workflows.composite import peak
from workflows.composite.backdrops.backdrop import Backdrop, backdrop_of, node_light
from workflows.composite.backdrops.placement import Placement
from workflows.images import decode, float_formats, integer_formats
from workflows.images.resample import area_mean
from workflows.images.tone_curves import table, to_light
from workflows.recovery.pyramid import Pyramid

COLUMNS, ROWS = 80, 60
MONITOR = (1280, 960)
MEMORY = 1 << 24


def cells(picture: NDArray[np.float32], **placement: float) -> NDArray[np.float32]:
    """The light of the first grid."""
    light = node_light(Backdrop(picture), COLUMNS, ROWS, 2, Placement(**placement), MONITOR)
    return light[: COLUMNS * ROWS].reshape(ROWS, COLUMNS, 3)


@pytest.fixture
def smooth() -> NDArray[np.float32]:
    y, x = np.mgrid[0:120, 0:160] / 40
    return np.stack([0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.5 + 0.2 * np.sin(x + y)], axis=2).astype(
        np.float32
    )


@pytest.mark.parametrize("size", [(60, 80), (120, 160), (31, 47), (200, 333), (1, 1), (1, 500), (997, 3)])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("threads", [1, 3])
def test_light_is_the_mean_over_cells_of_each_grid(
    size: tuple[int, int], channels: int, threads: int
) -> None:
    picture = np.random.default_rng(0).random((*size, channels), np.float32)
    found = node_light(Backdrop(picture), COLUMNS, ROWS, threads)
    expected = Pyramid.over(COLUMNS, ROWS).light(area_mean(picture, COLUMNS, ROWS))
    assert (found[-1] == 0).all()
    np.testing.assert_allclose(found[:-1], np.broadcast_to(expected, (len(found) - 1, 3)), atol=2e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_are_looked_up(dtype: type) -> None:
    codes = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (30, 40, 3), dtype, endpoint=True)
    light = table("srgb", np.dtype(dtype))
    found = node_light(Backdrop(codes, light), COLUMNS, ROWS, 2)
    np.testing.assert_array_equal(found, node_light(Backdrop(light[codes]), COLUMNS, ROWS, 2))


def test_a_backdrop_may_stay_where_it_is(smooth: NDArray[np.float32]) -> None:
    np.testing.assert_allclose(cells(smooth), area_mean(smooth, COLUMNS, ROWS), atol=0.01)


def test_a_backdrop_moves_right_and_down(smooth: NDArray[np.float32]) -> None:
    there, moved = cells(smooth), cells(smooth, right=0.25, down=0.1)
    np.testing.assert_allclose(moved[6:, 20:], there[:-6, :-20], atol=0.01)
    assert (moved[:6] == 0).all()
    assert (moved[:, :20] == 0).all()


def test_a_backdrop_turns_clockwise_on_square_pixels() -> None:
    picture = np.zeros((96, 128, 1), np.float32)
    picture[:, 64:] = 1  # the right half of the monitor, turned down to its lower half, as far as it reaches
    turned = cells(picture, angle=90)[..., 0]
    middle = turned[:, 10:70]  # a monitor of 4 to 3 on its side is 3/4 as wide as it was
    assert (middle[32:] == 1).all()
    assert (middle[:28] == 0).all()
    assert (turned[:, :9] == 0).all()
    assert (turned[:, -9:] == 0).all()


def test_a_backdrop_shrinks_about_its_centre_without_aliasing() -> None:
    checker = (np.indices((480, 640)).sum(axis=0) % 2).astype(np.float32)[..., np.newaxis]
    small = cells(checker, scale=0.5)[..., 0]
    np.testing.assert_allclose(small[17:43, 22:58], 0.5, atol=0.01)
    assert (small[:14] == 0).all()
    assert (small[:, :19] == 0).all()
    np.testing.assert_allclose(cells(checker, scale=0.5, angle=30)[28:32, 38:42], 0.5, atol=0.02)


def test_a_backdrop_grows_about_its_centre(smooth: NDArray[np.float32]) -> None:
    np.testing.assert_allclose(cells(smooth, scale=2), area_mean(smooth[30:90, 40:120], 80, 60), atol=0.01)


@pytest.mark.parametrize("placement", [{}, {"scale": 0.3, "angle": 20}])
def test_threads_change_nothing(placement: dict[str, float]) -> None:
    backdrop = Backdrop(np.random.default_rng(0).random((300, 211, 3), np.float32))
    one, four = (
        node_light(backdrop, 200, 150, threads, Placement(**placement), MONITOR) for threads in (1, 4)
    )
    np.testing.assert_array_equal(one, four)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(
    "placement", [{"scale": 1.0}, {"scale": 0.3, "angle": 20}, {"scale": 5, "angle": 20}]
)
def test_placed_backdrop_of_codes_equals_that_of_its_light(
    channels: int, placement: dict[str, float]
) -> None:
    codes = np.random.default_rng(0).integers(0, 256, (150, 200, channels), np.uint8)
    light = table("srgb", np.dtype(np.uint8))
    picture = light[codes[..., :3]]
    if channels == 4:
        picture *= codes[..., 3:] / np.float32(255)
    found, expected = (
        node_light(one, COLUMNS, ROWS, 2, Placement(**placement), MONITOR)
        for one in (Backdrop(codes, light), Backdrop(picture))
    )
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("placement", [{"scale": 47}, {"scale": 47, "angle": 30, "right": 15, "down": -12}])
def test_visible_part_of_an_enlarged_backdrop_equals_that_of_the_whole(
    placement: dict[str, float],
) -> None:
    picture = np.random.default_rng(0).random((3000, 4000, 1), np.float32)
    found = cells(picture, **placement)[..., 0]
    # of pixels that are as large as cells, about, as it is made first
    turned = Placement(**placement).matrix(MONITOR)
    steps = np.hypot(*(turned[:2, :2] / (COLUMNS, ROWS)).T) * (4000, 3000)
    assert (steps > 1).all()
    wide, high = (int(np.ceil(size / step)) for size, step in zip((4000, 3000), steps, strict=True))
    np.testing.assert_allclose(found, cells(area_mean(picture, wide, high), **placement)[..., 0], atol=1e-5)
    assert found.std() > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        ((3000, 4000, 3), "uint8"),
        ((3000, 4000, 4), "uint8"),
        ((2000, 3000, 3), "uint16"),
        ((2000, 3000, 1), "float32"),
    ],
)
def test_large_backdrop_takes_little_more_than_its_own_memory(
    shape: tuple[int, int, int], dtype: str
) -> None:
    size, grown = peak.of_large_after_small(shape, dtype)
    assert grown < size / 2


def saved(picture: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    target = io.BytesIO()
    picture.save(target, kind, **options)
    return target.getvalue()


def light_of(data: bytes, transfer: str = "srgb") -> np.ndarray:
    """The light of cells as large as the pixels of a picture."""
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
    np.testing.assert_allclose(light_of(data), to_light(unit, "srgb"), rtol=1e-6)
    np.testing.assert_allclose(light_of(data, "linear"), unit, rtol=1e-6)


def test_float_values_are_light() -> None:
    picture = np.array([[[0.5, 2, 4], [0, 1, -1]]], np.float32)
    assert light_of(float_formats.encode_exr("RGB", picture)).tolist() == picture.tolist()


def test_float_values_are_clipped_to_what_half_floats_hold() -> None:
    picture = np.array([[[1e38, -3e38, 65504], [6e4, 65505, -1], [np.inf, -np.inf, 0]]], np.float32)
    expected = [[[65504, -65504, 65504], [6e4, 65504, -1], [65504, -65504, 0]]]
    assert light_of(float_formats.encode_exr("RGB", picture)).tolist() == expected


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_transparent_pixels_are_darkened_in_proportion(codes: np.ndarray, depth: type) -> None:
    top = np.iinfo(depth).max
    deep = (codes.astype(np.uint32) * (top // 255)).astype(depth)
    alpha = np.full((5, 7, 1), top, depth)
    opaque = light_of(integer_formats.encode_png(np.concatenate([deep, alpha], axis=2)))
    np.testing.assert_array_equal(opaque, light_of(integer_formats.encode_png(deep)))
    alpha[0], alpha[1] = 0, top // 5
    seen = light_of(integer_formats.encode_png(np.concatenate([deep, alpha], axis=2)))
    assert (seen[0] == 0).all()
    np.testing.assert_allclose(seen[1], opaque[1] / 5, rtol=1e-3)
    np.testing.assert_array_equal(seen[2:], opaque[2:])


@pytest.mark.parametrize("mode", ["P", "L", "LA", "CMYK", "1"])
def test_other_kinds_of_pictures(codes: np.ndarray, mode: str) -> None:
    picture = Image.fromarray(codes).convert(mode)
    seen = light_of(saved(picture, "TIFF" if mode == "CMYK" else "PNG"))
    expected = to_light(np.asarray(picture.convert("RGB"), np.float32) / np.float32(255), "srgb")
    np.testing.assert_allclose(np.broadcast_to(seen, expected.shape), expected, atol=1e-6)


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_a_colour_profile_is_converted(codes: np.ndarray, depth: type) -> None:
    wide = imagecodecs.cms_profile("adobergb")
    deep = codes if depth is np.uint8 else codes.astype(np.uint16) * 257
    data = saved(Image.fromarray(codes), icc_profile=wide) if depth is np.uint8 else _png16(deep, wide)
    seen = light_of(data)
    srgb = ImageCms.createProfile("sRGB")
    expected = ImageCms.profileToProfile(
        Image.fromarray(codes), ImageCms.getOpenProfile(io.BytesIO(wide)), srgb
    )
    np.testing.assert_allclose(seen, to_light(np.asarray(expected, np.float32) / 255, "srgb"), atol=0.01)
    # values that are light are no colours of a profile
    np.testing.assert_allclose(light_of(data, "linear"), integer_formats.to_unit(codes), atol=1e-6)


def _png16(codes: np.ndarray, profile: bytes) -> bytes:
    """A PNG of 16 bits with an iCCP chunk (PNG, sect. 11.3.2.3)."""
    plain = integer_formats.encode_png(codes)
    body = b"iCCP" + b"wide\0\0" + zlib.compress(profile)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return plain[:33] + chunk + plain[33:]  # after IHDR


def test_invalid_colour_profile_is_refused(codes: np.ndarray) -> None:
    with pytest.raises(ImageError, match="colour profile"):
        light_of(saved(Image.fromarray(codes), icc_profile=b"no profile" * 20))


def test_backdrop_that_is_too_large_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(ImageError, match="takes more than"):
        light_of(saved(Image.new("RGB", (6000, 4000))))
