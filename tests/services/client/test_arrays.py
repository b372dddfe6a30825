"""Arrays of light as backdrops and composites."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from services.client import Client
from services.client._arrays import decode, encode


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 1), (3, 5, 3)])
def test_encoded_array_is_decoded_unchanged(shape: tuple[int, ...], tmp_path: Path) -> None:
    light = np.random.default_rng(1).normal(0, 4, shape).astype(np.float32)
    expected = np.broadcast_to(light.reshape(3, 5, -1), (3, 5, 3))
    np.testing.assert_array_equal(decode(encode(light)), expected)
    (tmp_path / "light.exr").write_bytes(encode(light))
    with OpenEXR.File(str(tmp_path / "light.exr")) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, expected)


@pytest.mark.parametrize(
    ("light", "reason"),
    [
        (np.zeros((3, 5), np.uint8), "uint8"),
        (np.zeros((3, 5, 4), np.float32), "not .3, 5, 4"),
        (np.zeros((0, 5), np.float32), "not .0, 5"),
        (np.zeros(5, np.float32), "not .5,"),
    ],
)
def test_array_that_is_no_backdrop_is_refused(light: np.ndarray, reason: str) -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(ValueError, match=reason):
        client.composite("m", light)
