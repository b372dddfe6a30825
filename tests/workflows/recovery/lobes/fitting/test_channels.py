"""One T for all channels or one for each: which pixels are disputed, and what they gain from some of both."""

import numpy as np
import pytest

from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.fitting.averages import adjacent
from workflows.recovery.lobes.fitting.channels import disputed

COLUMNS, ROWS = 64, 48


@pytest.fixture
def patterns(patterns_of):
    """Few: 12 for each channel."""
    return patterns_of([(8, 6, 4), (16, 12, 4), (COLUMNS, ROWS, 4)], 1, 3)


@pytest.fixture
def glass(gaussian, places):
    """T of glass that disperses the more, the further to the right."""
    pixels = []
    for row, column in places - places[0]:
        x, y, apart = 12 + 1.8 * column, 14 + 1.5 * row, 0.2 * column
        each = [gaussian(COLUMNS, ROWS, x + c * apart, y, 2, 1.5, 0.3)[:, 0] for c in (-0.65, 0, 1)]
        pixels.append(np.stack(each, axis=1))
    return np.concatenate(pixels)


def test_pixels_at_a_border_of_decisions_are_disputed():
    places = np.argwhere(np.ones((5, 6), bool))
    separate = places[:, 1] > 2
    assert np.array_equal(disputed(separate, adjacent(places)), np.isin(places[:, 1], (2, 3)))


def test_disputed_pixels_gain_from_some_of_both(patterns, glass, observe, places, monkeypatch):
    light, photometry, noise = observe(patterns, glass)
    backdrop = np.random.default_rng(1).random((ROWS, COLUMNS, 3), np.float32)
    expected = np.einsum("nci,ic->nc", glass, backdrop.reshape(-1, 3))

    def recovered():
        found = lobes.recover(light, photometry, patterns, noise, places=places).transport
        ones = np.ones((patterns.pyramid.nodes, 3), np.float32)
        np.testing.assert_allclose(found.apply(ones), 1, atol=2e-3)
        return np.mean((found.apply(patterns.pyramid.light(backdrop)) - expected) ** 2)

    of_both = recovered()
    monkeypatch.setattr(lobes, "disputed", lambda separate, near: np.zeros(len(separate), bool))
    assert of_both < 0.85 * recovered()
