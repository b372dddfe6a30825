"""Fits that start from neighbours: the order, an edge that stays an edge, and the same T as each pixel alone."""

import numpy as np
import pytest

from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.fitting.neighbours import coarse_to_fine

COLUMNS, ROWS = 64, 48
BANDS = [(8, 6, 20), (16, 12, 20), (32, 24, 20), (COLUMNS, ROWS, 20)]
HEIGHT, WIDTH = 8, 20


@pytest.fixture(scope="module")
def patterns(patterns_of):
    return patterns_of(BANDS, 1)


@pytest.fixture
def places():
    return np.argwhere(np.ones((HEIGHT, WIDTH), bool)) + np.array([24, 40])


@pytest.fixture
def scene(gaussian, observe, patterns, places):
    """A picture of glass with an edge: right of column 9 its light comes from elsewhere; and its true T."""
    pixels = []
    for row, column in places - places[0]:
        x, y = (12 + 0.6 * column, 10 + 0.5 * row) if column < 10 else (50 - 0.5 * column, 36 - 0.4 * row)
        pixels.append(gaussian(COLUMNS, ROWS, x, y, 2 + 0.05 * row, 1.5, 0.3)[0])
    T = np.stack(pixels)
    return observe(patterns, T), T


def error(T, transport, patterns):
    """Root mean square error of predictions of random backdrops, a pixel each."""
    light = np.random.default_rng(1).random((ROWS, COLUMNS, 3), np.float32)
    smooth = patterns.pyramid.light(light)
    expected = T.reshape(len(T), -1, ROWS * COLUMNS)[:, 0] @ light.reshape(-1, 3)
    return np.sqrt(np.mean((transport.apply(smooth) - expected) ** 2, axis=1))


@pytest.mark.parametrize("seed", [None, 0])
def test_each_pixel_comes_after_its_neighbours(places, seed):
    chosen = places if seed is None else np.random.default_rng(seed).permutation(places)[:70]
    order, neighbours = coarse_to_fine(chosen, len(chosen))
    assert sorted(order) == list(range(len(chosen)))
    turn = np.argsort(order)
    for p, near in enumerate(neighbours):
        for q in near[near >= 0]:
            assert turn[q] < turn[p]
            assert np.abs(chosen[p] - chosen[q]).max() <= 4
    if seed is None:
        assert (
            np.count_nonzero((neighbours < 0).all(axis=1)) == 3
        )  # of columns 40 to 59, those at 40, 48 and 56


def test_pixels_without_places_have_no_neighbours():
    order, neighbours = coarse_to_fine(None, 3)
    assert order.tolist() == [0, 1, 2]
    assert (neighbours == -1).all()


def test_neighbours_lose_nothing_and_edges_stay(scene, patterns, places):
    (measurements, photometry, noise), T = scene
    alone = lobes.recover(measurements, photometry, patterns, noise)
    together = lobes.recover(measurements, photometry, patterns, noise, places=places)
    apart, shared = (error(T, found.transport, patterns) for found in (alone, together))
    assert np.sqrt(np.mean(shared**2)) < 1.05 * np.sqrt(np.mean(apart**2))
    edge = np.isin(places[:, 1] - 40, (9, 10))
    assert np.sqrt(np.mean(shared[edge] ** 2)) < 1.1 * np.sqrt(np.mean(apart[edge] ** 2))


def test_one_step_suffices_beside_neighbours_that_took_theirs(scene, patterns, places):
    (measurements, photometry, noise), T = scene
    options = lobes.FINE._replace(steps=1, most_lobes=1, doubt=1.0)
    alone = lobes.recover(measurements, photometry, patterns, noise, options=options)
    together = lobes.recover(measurements, photometry, patterns, noise, options=options, places=places)
    apart, shared = (error(T, found.transport, patterns) for found in (alone, together))
    assert np.mean(shared) < np.mean(apart)
