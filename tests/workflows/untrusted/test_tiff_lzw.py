"""LZW of TIFFs: what encoders write is sound, and what would be read from nowhere is refused."""

import io

import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from storage.errors import ImageError
from workflows.images.integer_formats import decode

MEMORY = 1 << 22


def pictures() -> list[NDArray[np.uint8]]:
    """Tables that fill up, and codes that are the entry which they make."""
    rng = np.random.default_rng(3)
    sizes = ((1, 1), (1, 300), (200, 170), (37, 251))
    return [rng.integers(0, top, (*size, 3)).astype(np.uint8) for size in sizes for top in (1, 2, 9, 256)]


@pytest.mark.parametrize("by", ["libtiff", "imagecodecs"])
def test_files_of_common_encoders_are_read(by: str) -> None:
    for pixels in pictures():
        target = io.BytesIO()
        if by == "libtiff":
            Image.fromarray(pixels).save(target, "TIFF", compression="tiff_lzw")
        else:
            rows = max(1, len(pixels) // 3)
            tifffile.imwrite(target, pixels, photometric="rgb", compression="lzw", rowsperstrip=rows)
        np.testing.assert_array_equal(decode(target.getvalue(), memory=MEMORY), pixels)


@pytest.mark.parametrize("codes", [(256, 300), (256, 65, 260), (256, 65, 66, 260), (256, 65, 256, 258)])
def test_codes_of_nothing_are_refused(codes: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(4).integers(0, 255, (8, 8, 3), np.uint8)
    target = io.BytesIO()
    tifffile.imwrite(target, pixels, photometric="rgb", compression="lzw")
    data = target.getvalue()
    packed = imagecodecs.lzw_encode(pixels.tobytes())
    text = "".join(f"{code:09b}" for code in codes).ljust(8 * len(packed), "0")
    damaged = int(text, 2).to_bytes(len(packed), "big")
    assert packed in data
    with pytest.raises(ImageError, match="undefined codes"):
        decode(data.replace(packed, damaged), memory=MEMORY)
