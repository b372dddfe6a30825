"""Composites as integers, against the tone curve in double precision."""

from typing import Literal

import numpy as np
import pytest

from workflows.composite.quantise import encode


def exact(light: np.ndarray, transfer: str, top: int) -> np.ndarray:
    """IEC 61966-2-1, or none."""
    value = np.clip(light.astype(np.float64), 0, 1)
    if transfer == "srgb":
        value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return value * top


@pytest.mark.parametrize("transfer", ["srgb", "linear"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_light_is_encoded_and_rounded(transfer: Literal["srgb", "linear"], dtype: type) -> None:
    rng = np.random.default_rng(0)
    light = np.concatenate([rng.random(60_000), rng.random(60_000) ** 4, rng.uniform(-1, 2, 60_000), [0, 1]])
    picture = np.ones((len(light) // 2, 2, 4), np.float32)
    picture[..., 0] = light.reshape(-1, 2)
    codes = encode(picture, transfer, np.dtype(dtype), 2)
    assert codes.dtype == dtype
    assert codes.shape == picture.shape
    assert np.array_equal(encode(picture, transfer, np.dtype(dtype), 1, 3), codes[..., :3])
    top = np.iinfo(dtype).max
    # a code is the nearest one, up to what float32 can tell of the light
    off = np.abs(codes[..., 0] - exact(picture[..., 0], transfer, top))
    assert off.max() < (0.5001 if dtype == np.uint8 else 0.51)
    assert (codes[..., 1:] == top).all()


def test_values_that_are_no_light_are_black() -> None:
    picture = np.full((1, 3, 4), [[np.nan] * 4, [-np.inf] * 4, [np.inf] * 4], np.float32).reshape(1, 3, 4)
    picture[..., 3] = 0.5
    codes = encode(picture, "srgb", np.dtype(np.uint8), 1)
    assert codes.tolist() == [[[0, 0, 0, 128], [0, 0, 0, 128], [255, 255, 255, 128]]]
