"""The estimate of the detail that colours lose in films, against pictures of which it is known."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from workflows.ingest.report.colour_detail import ColourDetail

ALL = np.ones((64, 96), bool)


def coloured(sigma: float, colour: float) -> NDArray[np.float32]:
    """Pictures whose detail is as fine in all channels, and partly of each channel's own."""
    random = np.random.default_rng(3)
    common, own = random.standard_normal((8, 64, 96, 1)), random.standard_normal((8, 64, 96, 3))
    noise = gaussian_filter((1 - colour) * common + colour * own, (0, sigma, sigma, 0), mode="wrap")
    return (0.4 + 0.1 * noise / noise.std()).astype(np.float32)


def subsampled(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same with the brightness of each pixel, and the colour of each 2 x 2."""
    brightness = (light @ np.array([0.2126, 0.7152, 0.0722], np.float32))[..., np.newaxis]
    colour = (light - brightness).reshape(len(light), 32, 2, 48, 2, 3).mean(axis=(2, 4))
    return brightness + colour.repeat(2, axis=1).repeat(2, axis=2)


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.0])
@pytest.mark.parametrize("colour", [0.2, 0.5])
def test_lost_detail_is_estimated_within_a_factor_of_two(sigma: float, colour: float) -> None:
    light = coloured(sigma, colour)
    film = subsampled(light)
    detail = ColourDetail()
    for part in (slice(5), slice(5, None)):
        detail.add(film[part], ALL)
    assert 0.5 < detail.lost() / np.mean((film - light) ** 2) < 2


def test_grey_pictures_lose_nothing() -> None:
    detail = ColourDetail()
    detail.add(coloured(1, 0), ALL)
    assert detail.lost() < 1e-9


def test_only_wanted_pixels_count() -> None:
    light = coloured(1, 0)
    light[:, :, 48:] = coloured(1, 0.5)[:, :, 48:]
    left, right = ColourDetail(), ColourDetail()
    left.add(light, ALL & (np.arange(96) < 48))
    right.add(light, ALL & (np.arange(96) >= 48))
    assert left.lost() < 1e-9 < right.lost()


@pytest.mark.parametrize("light", [np.ones((0, 64, 96, 3), np.float32), np.ones((2, 64, 96, 3), np.float32)])
def test_pictures_without_detail_tell_nothing(light: NDArray[np.float32]) -> None:
    detail = ColourDetail()
    assert detail.lost() == 0
    detail.add(light, ALL)
    assert detail.lost() == 0
