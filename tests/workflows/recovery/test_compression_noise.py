"""The noise of frames of patterns, from the values that no pattern can cause."""

import numpy as np
import pytest

from workflows.recovery.compression_noise import estimate_excess


@pytest.mark.parametrize("blocks", [1, 2, 6])
def test_the_noise_of_patterns_is_found(blocks: int) -> None:
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


def test_values_within_tell_nothing() -> None:
    values = np.full((50, 20, 3), 0.5, np.float32)
    black, white = np.zeros((50, 3), np.float32), np.ones((50, 3), np.float32)
    assert estimate_excess(values, black, white, np.ones(values.shape, bool)) is None
