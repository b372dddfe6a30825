"""Pictures of every format are decoded upright, as their orientation says."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps

from storage.layout.captures import Stack
from workflows.images import camera_raw, decode, float_formats, integer_formats

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
    for data in (
        saved("JPEG", turn),
        saved("TIFF", turn, compression="jpeg"),
    ):  # the latter Pillow turns itself
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
