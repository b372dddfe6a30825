"""Camera RAW: a DNG made here, with known counts, by LibRaw to linear light."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from storage.errors import ImageError
from workflows.raw import decode, is_raw

MEMORY = 1 << 20
BLACK, WHITE = 256, 4095
COUNTS = np.random.default_rng(8).integers(200, 4000, (40, 60), np.uint16)
Dng = Callable[..., bytes]


def expected(counts: NDArray[Any]) -> NDArray[Any]:
    light = (counts.astype(np.float32) - BLACK) / (WHITE - BLACK)
    red, blue = light[::2, ::2], light[1::2, 1::2]
    return np.stack([red, (light[::2, 1::2] + light[1::2, ::2]) / 2, blue], axis=2)


def test_raw_is_told_by_the_name() -> None:
    assert is_raw("frames/IMG_0001.CR3")
    assert is_raw("a.dng")
    assert not is_raw("dng/a.tif")


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
    decode(data, memory=40 * 60 * 6)
    with pytest.raises(ImageError, match="60 x 40 elements") as caught:
        decode(data, memory=40 * 60 * 6 - 1)
    assert caught.value.fields == {"limit": 40 * 60 * 6 - 1}


def plain_tiff() -> bytes:
    target = io.BytesIO()
    tifffile.imwrite(target, np.ones((30, 30, 3), np.uint8), photometric="rgb", compression="zlib")
    return target.getvalue()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "cut off or damaged"),
        (bytes(5000), "RAW format is not known here: convert the frames to DNG"),
        (b"FUJIFILMCCD-RAW " + bytes(5000), "RAW"),
        (plain_tiff(), "RAW"),
    ],
)
def test_what_libraw_does_not_know_is_refused(data: bytes, why: str) -> None:
    with pytest.raises(ImageError, match=why):
        decode(data, memory=MEMORY)


def test_the_filters_colours_may_lie_otherwise(make_dng: Dng) -> None:
    light = decode(make_dng(COUNTS, BLACK, WHITE, pattern=(2, 1, 1, 0)), memory=MEMORY)
    np.testing.assert_allclose(light, expected(COUNTS)[:, :, ::-1], atol=1e-6)


def test_another_colour_filter_is_refused(make_dng: Dng) -> None:
    with pytest.raises(ImageError, match="RAW"):
        decode(make_dng(COUNTS, BLACK, WHITE, pattern=(0, 1, 1, 1)), memory=MEMORY)


def test_a_truncated_dng_is_refused(make_dng: Dng) -> None:
    data = make_dng(COUNTS, BLACK, WHITE)
    for length in np.linspace(0, len(data) * 0.9, 20).astype(int):
        with pytest.raises(ImageError):
            decode(data[:length], memory=MEMORY)
