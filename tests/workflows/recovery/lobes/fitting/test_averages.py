"""Averages of fits: which pixels lie about one, what they gain from few patterns, and an edge that stays an edge."""

import numpy as np
import pytest

from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.fitting.averages import adjacent

COLUMNS, ROWS = 64, 48
OFFSETS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]


@pytest.fixture(params=[1, 3], ids=["grey", "coloured"])
def patterns(patterns_of, request):
    each = 8 if request.param == 1 else 5
    return patterns_of([(8, 6, each), (16, 12, each), (COLUMNS, ROWS, each)], 1, request.param)


@pytest.fixture
def errors(scene, error, patterns, places, monkeypatch):
    """Square error of each pixel before a random backdrop: of its own fits alone, and of averages."""
    (light, photometry, noise), _ = scene

    def square():
        return error(lobes.recover(light, photometry, patterns, noise, places=places).transport) ** 2

    of_averages = square()
    monkeypatch.setattr(lobes, "adjacent", lambda places: np.full((len(places), 8), -1))
    return square(), of_averages


@pytest.mark.parametrize("share", [1.0, 0.6, 0.1])
def test_each_pixel_has_those_about_it(share):
    rng = np.random.default_rng(2)
    chosen = rng.permutation(np.argwhere(rng.random((12, 9)) < share)) + np.array([0, 7])
    number = {tuple(place): i for i, place in enumerate(chosen.tolist())}
    expected = [
        [number.get((row + r, column + c), -1) for r, c in OFFSETS] for row, column in chosen.tolist()
    ]
    assert adjacent(chosen).tolist() == expected


def test_no_pixels_have_none_about_them():
    assert adjacent(np.empty((0, 2), int)).shape == (0, 8)


def test_few_patterns_tell_more_together(errors):
    alone, averaged = errors
    assert averaged.mean() < 0.85 * alone.mean()


def test_an_edge_stays_an_edge(errors, places):
    alone, averaged = errors
    edge = np.isin(places[:, 1] - places[0, 1], (9, 10))
    assert averaged[edge].mean() < 1.1 * alone[edge].mean()


def test_shares_of_an_average_sum_to_one(scene, patterns, places):
    (light, photometry, noise), _ = scene
    found = lobes.recover(light, photometry, patterns, noise, places=places)
    ones = np.ones((patterns.pyramid.nodes, 3), np.float32)
    np.testing.assert_allclose(found.transport.apply(ones), 1, atol=2e-3)


@pytest.mark.parametrize("channels", [1, 3])
def test_channels_of_dispersing_glass_tell_more_together(patterns_of, gaussian, observe, channels):
    patterns = patterns_of([(8, 6, 8), (16, 12, 8), (COLUMNS, ROWS, 8)], 1, channels)
    rng = np.random.default_rng(5)
    pixels = []
    for x, y, angle in rng.uniform((12, 10, 0), (52, 38, 3), (60, 3)):
        each = [gaussian(COLUMNS, ROWS, x + 2 * c, y + c, 3, 1.5, angle)[:, 0] for c in (-1, 0, 1)]
        pixels.append(np.stack(each, axis=1))
    T = np.concatenate(pixels)
    light, photometry, noise = observe(patterns, T)
    backdrop = rng.random((ROWS, COLUMNS, 3), np.float32)
    expected = np.einsum("nci,ic->nc", T, backdrop.reshape(-1, 3))

    def error(places):
        found = lobes.recover(light, photometry, patterns, noise, places=places).transport
        return np.mean((found.apply(patterns.pyramid.light(backdrop)) - expected) ** 2)

    far_apart = 1000 * np.stack([np.arange(len(T)), np.zeros(len(T), int)], axis=1)
    assert error(far_apart) < 0.9 * error(None)
