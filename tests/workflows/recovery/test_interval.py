"""Intervals: the contrast of a backdrop, and how much of it is in the errors of predictions."""

import numpy as np
import pytest

from workflows.recovery.camera.noise import Noise
from workflows.recovery.interval import fit_interval, local_contrast

NOISE = Noise(1e-5, 1e-4)


def test_contrast_is_that_around_a_cell() -> None:
    light = np.full((40, 60, 2), 0.3, np.float32)
    light[:, 30:, 0] = 0.9
    contrast = local_contrast(light, light**2)
    assert contrast[..., 1].max() < 1e-6
    assert contrast[:, :20, 0].max() < 1e-6
    np.testing.assert_allclose(contrast[:, 29:31, 0], 0.09, rtol=0.1)  # half of it on either side
    assert (np.diff(contrast[5, 30:, 0]) <= 1e-7).all()


def test_contrast_within_cells_counts() -> None:
    flat = np.full((9, 12, 1), 0.5, np.float32)
    np.testing.assert_allclose(local_contrast(flat, flat), 0.25, rtol=1e-5)  # black and white in each cell


@pytest.mark.parametrize("further", [0.0, 4e-4])
def test_interval_holds_what_it_was_fitted_to(further: float) -> None:
    rng = np.random.default_rng(0)
    contrast = rng.random(20_000) ** 4 / 4
    variance = NOISE.variance(rng.random(contrast.size))
    spread = np.sqrt(0.02 * contrast + variance + further)
    found = fit_interval(
        spread * rng.standard_normal(contrast.size), contrast, variance, 0.5, NOISE, 140, (0, 0)
    )
    assert found.contrast == pytest.approx(0.02, rel=0.1)
    assert found.read == pytest.approx(NOISE.read * 2.5 / 140)
    assert found.share == pytest.approx(further / 0.5**2, rel=0.3, abs=1e-5)
    light, rho = np.full(4, 0.5, np.float32), np.array([0, 0.5, 1, 1], np.float32)
    half = found.half_width(light, rho, rho * np.array([0.25, 0.25, 0.25, 0], np.float32))
    assert (np.diff(half[:3]) > 0).all()
    assert half[3] < half[2]


def test_errors_of_the_model_count_in_proportion() -> None:
    rng = np.random.default_rng(0)
    error, contrast = 1e-3 * rng.standard_normal(1000), rng.random(1000)
    found = fit_interval(error, contrast, np.full(1000, 1e-6), 0.5, NOISE, 100, (0.04, 0.03))
    assert found.share == pytest.approx(0.03**2 + 0.04**2 * 2.5 / 100)
    assert found.contrast < 1e-9


def test_errors_without_contrast_do_not_make_it_count_for_more_than_all() -> None:
    rng = np.random.default_rng(0)
    contrast = np.where(rng.random(5000) < 0.3, 1e-6, 1e-5)
    spread = np.where(contrast < 5e-6, 1e-3, 0.1)
    error = spread * rng.standard_normal(5000)
    found = fit_interval(error, contrast, np.full(5000, 1e-7), 0.5, NOISE, 100, (0, 0))
    assert found.contrast == 1
    half = found.half_width(np.zeros(5000, np.float32), np.float32(0.5), contrast.astype(np.float32))
    assert np.mean(np.abs(error) <= half) == pytest.approx(0.9, abs=0.02)
