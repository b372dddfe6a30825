"""PNG files written band by band, read by libpng and Pillow."""

import io
from typing import Any

import imagecodecs
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from workflows.images.integer_formats import encode_png
from workflows.images.writers.png import STRIP_BYTES, write_png
from workflows.interruption import interruptible

RNG = np.random.default_rng(0)


def noise(*shape: int, dtype: type[np.unsignedinteger[Any]]) -> NDArray[np.unsignedinteger[Any]]:
    return RNG.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def ramp(*shape: int, dtype: type[np.unsignedinteger[Any]]) -> NDArray[np.unsignedinteger[Any]]:
    """Rows that are like those above, and pixels that are like those before: each filter is chosen for some."""
    height, width, channels = shape
    rows, columns = np.mgrid[:height, :width]
    values = np.where(rows < height // 2, 3 * columns, 5 * rows + columns % 7)[..., np.newaxis]
    return (values + np.arange(channels)).astype(dtype)


@pytest.mark.parametrize("make", [noise, ramp])
@pytest.mark.parametrize("size", [(1, 1), (7, 1), (1, 9), (301, 1700)], ids=str)
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_all_values_are_read_back(make: Any, size: tuple[int, int], channels: int, dtype: Any) -> None:
    pixels = make(*size, channels, dtype=dtype)
    whole = encode_png(pixels)
    found = imagecodecs.png_decode(whole)
    np.testing.assert_array_equal(found.reshape(pixels.shape), pixels)
    assert found.dtype == dtype
    with Image.open(io.BytesIO(whole)) as picture:
        picture.load()  # checks the chunks
        assert picture.size == size[::-1]


@pytest.mark.parametrize("rows", [1, 16, 100])
def test_bands_join_without_a_seam(rows: int) -> None:
    pixels = ramp(75, 40, 3, dtype=np.uint16)
    file = io.BytesIO()
    bands = (pixels[first : first + rows] for first in range(0, 75, rows))
    write_png(file, 40, 75, 3, np.uint16, bands)
    np.testing.assert_array_equal(imagecodecs.png_decode(file.getvalue()), pixels)


def test_what_a_camera_sees_is_packed_no_worse_than_by_a_library() -> None:
    rows, columns = np.mgrid[:400, :600] / 200
    smooth = np.stack([np.sin(columns + c) * np.cos(rows - c) for c in range(3)], axis=-1)
    pixels = (100 + 90 * smooth + RNG.normal(size=smooth.shape)).astype(np.uint8)
    assert len(encode_png(pixels)) < len(imagecodecs.png_encode(pixels))


def test_writing_ends_between_two_strips() -> None:
    pixels = np.zeros((4 * STRIP_BYTES // 3000, 1000, 3), np.uint8)
    strips = 0

    def check() -> None:
        nonlocal strips
        strips += 1
        if strips == 3:
            raise TimeoutError

    with interruptible(check), pytest.raises(TimeoutError):
        encode_png(pixels)
    assert strips == 3
