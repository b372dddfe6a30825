"""Fits that start from neighbours: the order, an edge that stays an edge, and the same T as each pixel alone."""

import numpy as np
import pytest

from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.fitting.neighbours import coarse_to_fine

COLUMNS, ROWS = 64, 48
BANDS = [(8, 6, 20), (16, 12, 20), (32, 24, 20), (COLUMNS, ROWS, 20)]


@pytest.fixture(scope="module")
def patterns(patterns_of):
    return patterns_of(BANDS, 1)


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
        # Of columns 40 to 59, those at 40, 48 and 56.
        assert np.count_nonzero((neighbours < 0).all(axis=1)) == 3


def test_pixels_without_places_have_no_neighbours():
    order, neighbours = coarse_to_fine(None, 3)
    assert order.tolist() == [0, 1, 2]
    assert (neighbours == -1).all()


def test_neighbours_lose_nothing_and_edges_stay(scene, error, patterns, places):
    (light, photometry, noise), _ = scene
    alone = lobes.recover(light, photometry, patterns, noise)
    together = lobes.recover(light, photometry, patterns, noise, places=places)
    apart, shared = (error(found.transport) for found in (alone, together))
    assert np.sqrt(np.mean(shared**2)) < 1.05 * np.sqrt(np.mean(apart**2))
    edge = np.isin(places[:, 1] - 40, (9, 10))
    assert np.sqrt(np.mean(shared[edge] ** 2)) < 1.1 * np.sqrt(np.mean(apart[edge] ** 2))


def test_one_step_suffices_beside_neighbours_that_took_theirs(scene, error, patterns, places):
    (light, photometry, noise), _ = scene
    options = lobes.FINE._replace(steps=1, most_lobes=1, doubt=1.0)
    alone = lobes.recover(light, photometry, patterns, noise, options=options)
    together = lobes.recover(light, photometry, patterns, noise, options=options, places=places)
    apart, shared = (error(found.transport) for found in (alone, together))
    assert np.mean(shared) < np.mean(apart)
