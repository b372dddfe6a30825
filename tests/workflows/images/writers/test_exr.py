"""EXR files written band by band, read by OpenEXR itself."""

import io

import numpy as np
import OpenEXR
import pytest

from workflows.images.writers.exr import LINES, write_exr
from workflows.interruption import interruptible

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("height", [1, LINES, LINES + 1, 3 * LINES + 5])
@pytest.mark.parametrize("band", [LINES, 2 * LINES])
def test_all_values_and_attributes_are_read_back(height: int, band: int) -> None:
    width = 7
    planes = {
        "lobe0.weight.R": RNG.normal(size=(height, width)).astype(np.float16),
        "A": np.ones((height, width), np.float32),
        "R": RNG.normal(size=(height, width)).astype(np.float32),
    }
    planes["R"][0, 0] = np.inf
    file = io.BytesIO()
    crosstalk = RNG.normal(size=(3, 3)).astype(np.float32)
    write_exr(
        file,
        width,
        height,
        {name: plane.dtype.type for name, plane in planes.items()},
        ({name: plane[y : y + band] for name, plane in planes.items()} for y in range(0, height, band)),
        {"crosstalk": crosstalk, "monitor": (1920, 1080), "comments": "ü"},
    )
    with OpenEXR.File(io.BytesIO(file.getvalue()), separate_channels=True) as read:
        assert read.channels().keys() == planes.keys()
        for name, plane in planes.items():
            np.testing.assert_array_equal(read.channels()[name].pixels, plane)
            assert read.channels()[name].pixels.dtype == plane.dtype
        header = read.header()
        np.testing.assert_array_equal(header["crosstalk"], crosstalk)
        assert tuple(header["monitor"]) == (1920, 1080)
        assert header["comments"] == "ü"


def test_writing_ends_when_nobody_wants_the_file() -> None:
    bands = ({"Y": np.zeros((LINES, 4), np.float32)} for _ in range(100))
    asked: list[int] = []

    def check() -> None:
        asked.append(1)
        if len(asked) == 3:
            raise TimeoutError

    with interruptible(check), pytest.raises(TimeoutError):
        write_exr(io.BytesIO(), 4, 100 * LINES, {"Y": np.float32}, bands)
    assert len(list(bands)) == 97
