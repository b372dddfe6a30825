"""The line of a camera's noise, from samples of squared errors."""

import numpy as np
import pytest

from workflows.recovery.noise import Noise, noise_line


@pytest.mark.parametrize("trim", [0.9, 1.0])
def test_the_line_is_that_of_the_samples(trim):
    rng = np.random.default_rng(0)
    level = rng.uniform(0, 1, 100_000)
    noise = Noise(4e-6, 5e-5)
    found = noise_line(level, noise.variance(level) * rng.standard_normal(level.size) ** 2, 1e-12, trim=trim)
    assert found.read == pytest.approx(noise.read, rel=0.15)
    assert found.shot == pytest.approx(noise.shot, rel=0.05)


def test_no_variance_is_below_the_floor():
    found = noise_line(np.linspace(0, 1, 1000), np.zeros(1000), 1e-6)
    assert found.read == pytest.approx(1e-6)
    assert found.shot == pytest.approx(0, abs=1e-12)


def test_few_samples_are_no_line():
    assert noise_line(np.linspace(0, 1, 119), np.ones(119), 1e-12) is None
    assert noise_line(np.linspace(0, 1, 120), np.ones(120), 1e-12) is not None
