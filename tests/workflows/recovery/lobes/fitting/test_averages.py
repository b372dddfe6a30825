"""Averages of fits: which pixels lie about one, what they gain from few patterns, and an edge that stays an edge."""

import numpy as np
import pytest

from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.fitting.averages import adjacent

COLUMNS, ROWS = 64, 48
HEIGHT, WIDTH = 8, 20
OFFSETS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]


@pytest.fixture
def places():
    return np.argwhere(np.ones((HEIGHT, WIDTH), bool)) + np.array([24, 40])


@pytest.fixture(params=[1, 3], ids=["grey", "coloured"])
def patterns(patterns_of, request):
    each = 8 if request.param == 1 else 5
    return patterns_of([(8, 6, each), (16, 12, each), (COLUMNS, ROWS, each)], 1, request.param)


@pytest.fixture
def scene(gaussian, observe, patterns, places):
    """A picture of glass with an edge, right of column 9: its measurements and its true T."""
    pixels = []
    for row, column in places - places[0]:
        x, y = (12 + 0.6 * column, 10 + 0.5 * row) if column < 10 else (50 - 0.5 * column, 36 - 0.4 * row)
        pixels.append(gaussian(COLUMNS, ROWS, x, y, 2 + 0.05 * row, 1.5, 0.3)[0])
    T = np.stack(pixels)
    return observe(patterns, T), T


@pytest.fixture
def errors(scene, patterns, places, monkeypatch):
    """Square error of each pixel before a random backdrop: of its own fits alone, and of averages."""
    (measurements, photometry, noise), T = scene
    light = np.random.default_rng(1).random((ROWS, COLUMNS, 3), np.float32)
    expected = T.reshape(len(T), -1, ROWS * COLUMNS)[:, 0] @ light.reshape(-1, 3)

    def error():
        found = lobes.recover(measurements, photometry, patterns, noise, places=places)
        return np.mean((found.transport.apply(patterns.pyramid.light(light)) - expected) ** 2, axis=1)

    of_averages = error()
    monkeypatch.setattr(lobes, "FEW", 0)
    return error(), of_averages


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
    (measurements, photometry, noise), _ = scene
    found = lobes.recover(measurements, photometry, patterns, noise, places=places)
    ones = np.ones((patterns.pyramid.nodes, 3), np.float32)
    np.testing.assert_allclose(found.transport.apply(ones), 1, atol=2e-3)
