"""The line of a camera's noise, and the noise of pattern frames."""

import numpy as np
import pytest

from workflows.recovery.camera.noise import NoiseModel, estimate_excess, fit_noise


@pytest.mark.parametrize("trim", [0.9, 1.0])
def test_line_fits_the_samples(trim):
    rng = np.random.default_rng(0)
    level = rng.uniform(0, 1, 100_000)
    noise = NoiseModel(4e-6, 5e-5)
    found = fit_noise(level, noise.variance(level) * rng.standard_normal(level.size) ** 2, 1e-12, trim=trim)
    assert found.read == pytest.approx(noise.read, rel=0.15)
    assert found.shot == pytest.approx(noise.shot, rel=0.05)


@pytest.mark.parametrize("dark", [500, 1500, 2500, 20_000])
def test_line_fits_however_few_of_the_values_are_dark(dark):
    rng = np.random.default_rng(0)
    level = np.concatenate([rng.uniform(0.005, 0.015, dark), rng.uniform(0.8, 0.95, 30_000)])
    noise = NoiseModel(6e-6, 6e-5)
    found = fit_noise(level, noise.variance(level) * rng.standard_normal(level.size) ** 2, 1e-12)
    assert found.read == pytest.approx(noise.read, rel=0.15)


def test_variance_is_at_least_the_floor():
    found = fit_noise(np.linspace(0, 1, 1000), np.zeros(1000), 1e-6)
    assert found.read == pytest.approx(1e-6)
    assert found.shot == pytest.approx(0, abs=1e-12)


def test_too_few_samples_give_none():
    assert fit_noise(np.linspace(0, 1, 119), np.ones(119), 1e-12) is None
    assert fit_noise(np.linspace(0, 1, 120), np.ones(120), 1e-12) is not None


@pytest.mark.parametrize("blocks", [1, 2, 6])
def test_excess_is_found_in_values_beyond_black_and_white(blocks: int) -> None:
    # A pixel sees the mean of some blocks, black or white; what is assumed of the values near both is the worst case.
    random = np.random.default_rng(blocks)
    black = np.full((400, 3), 0.05, np.float32)
    white = np.linspace(0.3, 0.9, 1200, dtype=np.float32).reshape(400, 3)
    lit = random.integers(0, 2, (400, 100, 3, blocks)).mean(axis=3)
    true = black[:, None] + lit * (white - black)[:, None]
    variance = 1e-6 + 2e-4 * true
    values = (true + np.sqrt(variance) * random.standard_normal(true.shape)).astype(np.float32)
    found = estimate_excess(values, black, white, np.ones(values.shape, bool))
    assert found is not None
    for level in (0.05, 0.3, 0.8):
        ratio = float(found.variance(np.array([level], np.float32))[0]) / (1e-6 + 2e-4 * level)
        assert 0.9 < ratio < 1.7


def test_values_between_black_and_white_give_no_excess() -> None:
    values = np.full((50, 20, 3), 0.5, np.float32)
    black, white = np.zeros((50, 3), np.float32), np.ones((50, 3), np.float32)
    assert estimate_excess(values, black, white, np.ones(values.shape, bool)) is None
