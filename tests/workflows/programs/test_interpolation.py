"""Light of interpolated pictures, against pictures that are enlarged in full."""

import numpy as np
import pytest
from scipy.ndimage import zoom

from workflows.images.resample import area_mean, stretch
from workflows.images.tone_curves import Curve, Gamma, to_light
from workflows.ingest.camera.curve import LOST
from workflows.programs.interpolation import interpolated_light
from workflows.programs.parts import Halftone, Monitor

TIMES = 16


@pytest.mark.parametrize("curve", ["srgb", Gamma(gamma=2.2), "linear"])
def test_light_is_the_mean_of_an_enlarged_picture(curve: Curve) -> None:
    picture = np.random.default_rng(0).random((12, 17)) < 0.5
    enlarged = zoom(picture.astype(np.float32), TIMES, order=1, mode="nearest", grid_mode=True)
    expected = area_mean(to_light(enlarged, curve)[..., np.newaxis], 17, 12)[..., 0]
    np.testing.assert_allclose(interpolated_light(picture, curve), expected, atol=2e-3)


def test_plain_areas_and_what_lies_beyond_the_edges_are_unchanged() -> None:
    picture = np.zeros((6, 8), bool)
    picture[:, 4:] = True
    light = interpolated_light(picture, "srgb")
    assert (light[:, :3] == 0).all()
    assert (light[:, 5:] == 1).all()
    assert (light[:, 3:5] == light[0, 3:5]).all()
    assert 0 < light[0, 3] < 1 - light[0, 4]


@pytest.mark.parametrize(("level", "lost"), LOST.items())
def test_half_tones_lose_as_much_as_they_are_recognised_by(level: float, lost: float) -> None:
    dots = Halftone(kind="halftone", levels=(level,)).values(0, Monitor(width=128, height=96))
    picture = stretch(dots, 128, 96)[..., 0] > 0
    light = interpolated_light(picture, Gamma(gamma=2.2))[8:-8, 8:-8]
    assert level - light.mean() == pytest.approx(lost, rel=0.05)
