"""Which series count as growth."""

import numpy as np
import pytest

from tests.benchmarks.soak.trends import trend


def noisy(growth: float, scatter: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 100 + growth * np.linspace(0, 1, 12) + rng.normal(0, scatter, 12)


@pytest.mark.parametrize("seed", range(20))
def test_growth_is_distinguished_from_scatter(seed: int) -> None:
    assert trend(noisy(20, 1, seed), least=4, share=0.02).grows
    assert not trend(noisy(0, 5, seed), least=4, share=0.02).grows
    assert not trend(noisy(-20, 1, seed), least=4, share=0.02).grows


def test_allowed_growth_does_not_count() -> None:
    values = np.linspace(100, 106, 12)
    assert trend(values, least=4, share=0).grows
    assert not trend(values, least=7, share=0).grows
    assert not trend(values, least=0, share=0.1).grows
    found = trend(values, least=0, share=0)
    assert (found.first, found.last, found.error) == pytest.approx((100, 106, 0))


def test_constant_series_does_not_grow() -> None:
    assert not trend([3, 3, 3, 3], least=0, share=0).grows
