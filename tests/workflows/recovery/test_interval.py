"""Intervals: the contrast of a backdrop, and how much of it is in the errors of predictions."""

import numpy as np
import pytest

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.interval import GROWTH, POWER, Interval, fit_interval, local_contrast
from workflows.recovery.pyramid import Pyramid

NOISE = NoiseModel(1e-5, 1e-4)


def contrast_of(mean: np.ndarray, square: np.ndarray) -> tuple[Pyramid, np.ndarray]:
    pyramid = Pyramid.over(mean.shape[1], mean.shape[0])
    return pyramid, local_contrast(pyramid, pyramid.light(mean), pyramid.light(square))


def test_contrast_is_that_around_a_node() -> None:
    light = np.full((80, 128, 2), 0.3, np.float32)
    light[:, 64:, 0] = 0.9
    pyramid, contrast = contrast_of(light, light**2)
    assert contrast.shape == (pyramid.nodes, 2)
    assert contrast[:, 1].max() < 1e-6
    for (columns, rows), start in zip(pyramid.grids, pyramid.starts, strict=False):
        row = contrast[start : start + columns * rows, 0].reshape(rows, columns)[rows // 2]
        assert row[: columns // 2 - max(columns // 16, 2)].max() < 1e-6
        # 0.09 where half of it is on either side.
        assert row[columns // 2 - 1 : columns // 2 + 1].min() > 0.02
        np.testing.assert_allclose(row, row[::-1], atol=1e-5)


def test_contrast_within_cells_counts() -> None:
    flat = np.full((9, 12, 1), 0.5, np.float32)
    np.testing.assert_allclose(contrast_of(flat, flat)[1], 0.25, rtol=1e-5)  # black and white in each cell


@pytest.mark.parametrize("further", [0.0, 4e-4])
def test_interval_holds_what_it_was_fitted_to(further: float) -> None:
    rng = np.random.default_rng(0)
    contrast = rng.random(20_000) ** 8 / 4  # a fifth has next to none
    variance = NOISE.variance(rng.random(contrast.size))
    spread = np.sqrt(0.02 * contrast**POWER + variance + further)
    found = fit_interval(
        spread * rng.standard_normal(contrast.size), contrast, variance, 0.5, NOISE, 140, (0, 0), 0
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
    found = fit_interval(error, contrast, np.full(1000, 1e-6), 0.5, NOISE, 100, (0.04, 0.03), 0)
    assert found.share == pytest.approx(0.03**2 + 0.04**2 * 2.5 / 100)
    assert found.contrast < 1e-9


def test_errors_are_smaller_when_no_pattern_is_held_out_and_noise_is_not() -> None:
    rng = np.random.default_rng(0)
    contrast = rng.random(5000) / 4
    error = np.sqrt(0.02 * contrast**POWER + 1e-4) * rng.standard_normal(5000)
    all_used, some_used = (
        fit_interval(error, contrast, np.full(5000, 1e-7), 0.5, NOISE, 100, (0, 0), held_out)
        for held_out in (0, 0.1)
    )
    assert some_used.contrast == pytest.approx(0.9**GROWTH * all_used.contrast)
    assert some_used.share == pytest.approx(0.9**GROWTH * all_used.share)
    assert (some_used.read, some_used.shot) == (all_used.read, all_used.shot)


def test_errors_too_large_for_their_contrast_are_a_share_of_the_light() -> None:
    rng = np.random.default_rng(0)
    contrast = np.where(rng.random(5000) < 0.3, 1e-6, 1e-5)
    spread = np.where(contrast < 5e-6, 1e-3, 0.1)
    error = spread * rng.standard_normal(5000)
    found = fit_interval(error, contrast, np.full(5000, 1e-7), 0.5, NOISE, 100, (0, 0), 0)
    assert found.contrast == 0
    half = found.half_width(np.zeros(5000, np.float32), np.float32(0.5), contrast.astype(np.float32))
    assert np.mean(np.abs(error) <= half) == pytest.approx(0.9, abs=0.02)


def test_a_wider_interval_is_wider_by_the_factor() -> None:
    interval = Interval(0.5, 1e-6, 1e-5, 1e-4)
    values = [np.full(3, value, np.float32) for value in (0.4, 0.8, 0.01)]
    np.testing.assert_allclose(
        interval.wider(1.5).half_width(*values), 1.5 * interval.half_width(*values), rtol=1e-5
    )
