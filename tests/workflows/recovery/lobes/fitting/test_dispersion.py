"""Lobes that glass has moved apart in red, green and blue: where they lie, and how far apart."""

import numpy as np
import pytest

from workflows.recovery.lobes.fitting.search import find_node, fit
from workflows.recovery.lobes.footprint import PARAMETERS, PatternCodes
from workflows.recovery.lobes.mixture import RATES, Mixture, make_workspace
from workflows.recovery.lobes.options import FINE
from workflows.recovery.lobes.recover import recover

COLUMNS, ROWS = 256, 192
SIGMA = 0.01
DISPERSION = np.array([6.0, -4.0])


@pytest.fixture(scope="module")
def patterns(patterns_of):
    """Few: 14 for each channel."""
    bands = [(8, 6, 4), (16, 12, 4), (32, 24, 2), (64, 48, 2), (128, 96, 1), (COLUMNS, ROWS, 1)]
    return patterns_of(bands, 1, 3)


@pytest.fixture(scope="module")
def codes(patterns):
    def of(dispersed):
        strays = np.ones((1, patterns.count + 2), np.float32)
        return PatternCodes(patterns.pyramid.arrays, patterns.code, 0, 3, patterns.count, strays, dispersed)

    return of


@pytest.fixture(scope="module")
def dispersed(gaussian):
    """(1, 3, cells) a Gaussian's shares, whose centre in green is at x, y."""

    def of(x, y, major, minor, angle):
        places = np.array([x, y]) + np.outer(RATES, DISPERSION)
        return np.stack([gaussian(COLUMNS, ROWS, *at, major, minor, angle)[:, 0] for at in places], axis=1)

    return of


def measure(patterns, T):
    """Noisy measurements (3 (m + 2),) of T (3, cells) in +-1 form."""
    rng = np.random.default_rng(0)
    signed = (patterns.code[: COLUMNS * ROWS] / 127.5 - 1).reshape(COLUMNS * ROWS, 3, -1)
    y = np.stack([np.append(T[c] @ signed[:, c], [-1.0, 1.0]) for c in range(3)]).reshape(-1)
    return (y + SIGMA * rng.standard_normal(y.size)).astype(np.float32)


def test_first_node_is_found_in_all_channels(patterns, codes):
    m, code = patterns.count, patterns.code
    at = [row * COLUMNS + column for column, row in ((137, 90), (141, 87), (147, 83))]
    light = np.stack([code[node, c * m : (c + 1) * m] for c, node in enumerate(at)])
    y = np.pad(light / 127.5 - 1, ((0, 0), (0, 2)))
    y[:, m:] = -1, 1
    f = np.tile(np.append(np.zeros(m), [-1, 1]), 3).astype(np.float32)
    found = np.zeros(2)
    precision = np.ones(f.size, np.float32)
    node = find_node(codes(dispersed=True), y.reshape(-1).astype(np.float32), f, precision, 6, True, found)
    assert node[:3] == (0, 141, 87)
    np.testing.assert_allclose(found, DISPERSION, atol=1)  # 14 patterns do not tell neighbouring nodes apart


def test_fit_finds_lobe_and_dispersion(patterns, codes, dispersed):
    y = measure(patterns, dispersed(130, 82, 4.0, 2.5, 0.4)[0])
    variance = np.full(y.size, SIGMA**2, np.float32)
    objective = {}
    for apart in (False, True):
        mixture = Mixture(np.zeros((3, PARAMETERS)), np.zeros(3, np.int64), np.zeros(3), np.zeros(2))
        workspace = make_workspace(3 * patterns.count)
        k, _, objective[apart] = fit(
            codes(apart), y, variance, mixture, 0, FINE._replace(most_lobes=1), workspace
        )
        assert k == 1
        if apart:
            np.testing.assert_allclose(mixture.lobes[0, 1:3], [130, 82], atol=0.3)
            np.testing.assert_allclose(mixture.dispersion, DISPERSION, atol=0.4)
        else:
            assert not mixture.dispersion.any()
    assert objective[True] < objective[False] - 100


def test_places_are_found_with_few_patterns(patterns, dispersed, observe):
    rng = np.random.default_rng(5)
    shapes = [
        (*rng.uniform((40, 30), (216, 162)), *rng.uniform(2, 4, 2), rng.uniform(0, 3)) for _ in range(40)
    ]
    truth = np.concatenate([dispersed(*shape) for shape in shapes])
    light, photometry, noise = observe(patterns, truth)
    found = recover(light, photometry, patterns, noise).transport
    ramp = np.tile(np.arange(COLUMNS, dtype=np.float32)[:, np.newaxis], (ROWS, 1, 3))
    error = found.apply(patterns.pyramid.light(ramp)) - truth @ ramp[..., 0].reshape(-1)
    assert np.mean(np.abs(error).max(axis=1) < 1) > 0.9
