"""The variance that a prediction leaves out is found, and lobes cost what their places do."""

import numpy as np
import pytest

from workflows.recovery.lobes.likelihood import penalty, weigh
from workflows.recovery.pyramid import Pyramid


def test_weigh_finds_the_variance_that_is_left_out():
    rng = np.random.default_rng(0)
    m, kappa = 20_000, 0.02
    f = rng.uniform(-1, 1, m + 2).astype(np.float32)
    variance = rng.uniform(1e-4, 2e-3, m + 2).astype(np.float32)
    share = np.maximum(1 - f.astype(float) ** 2, 0.02)
    share[m:] = 0
    total = variance + kappa * share
    y = (f + np.sqrt(total) * rng.standard_normal(m + 2)).astype(np.float32)
    precision = np.empty_like(y)
    found, objective = weigh(y, f, variance, 1, 0, precision)
    assert found == pytest.approx(kappa, rel=0.05)
    np.testing.assert_allclose(precision, 1 / (variance + found * share), rtol=1e-5)
    total = variance + found * share
    assert objective == pytest.approx(((y - f) ** 2 / total + np.log(total)).sum(), rel=1e-4)
    exact = f + np.sqrt(variance / 2) * rng.standard_normal(m + 2)
    assert weigh(exact.astype(np.float32), f, variance, 1, 0, precision)[0] == 0


def test_a_place_among_fewer_nodes_costs_less():
    grids = Pyramid(((64, 48), (32, 24))).arrays
    level = np.array([0, 1])
    expected = 16 + 2 * np.log(64 * 48) + 2 * np.log(32 * 24)
    assert penalty(grids, level, 2) == pytest.approx(expected)
    assert penalty(grids, level, 0) == 0
