"""A picture of glass with an edge, under the patterns of a test, and the error of what is recovered of it."""

import numpy as np
import pytest

HEIGHT, WIDTH = 8, 20


@pytest.fixture
def places():
    return np.argwhere(np.ones((HEIGHT, WIDTH), bool)) + np.array([24, 40])


@pytest.fixture
def scene(gaussian, observe, patterns, places):
    """A picture of glass with an edge: right of column 9 its light comes from elsewhere; and its true T."""
    columns, rows = patterns.pyramid.grids[0]
    pixels = []
    for row, column in places - places[0]:
        x, y = (12 + 0.6 * column, 10 + 0.5 * row) if column < 10 else (50 - 0.5 * column, 36 - 0.4 * row)
        pixels.append(gaussian(columns, rows, x, y, 2 + 0.05 * row, 1.5, 0.3)[0])
    T = np.stack(pixels)
    return observe(patterns, T), T


@pytest.fixture
def error(scene, patterns):
    """Root mean square error of predictions of a random backdrop by a T, a pixel each."""
    columns, rows = patterns.pyramid.grids[0]
    light = np.random.default_rng(1).random((rows, columns, 3), np.float32)
    expected = scene[1][:, 0] @ light.reshape(-1, 3)
    smooth = patterns.pyramid.light(light)

    def of(transport):
        return np.sqrt(np.mean((transport.apply(smooth) - expected) ** 2, axis=1))

    return of
