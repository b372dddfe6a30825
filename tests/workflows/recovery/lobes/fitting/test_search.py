"""Lobes fitted to measurements: what is there is found, noise pays for none, what was not measured is left out."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.recovery.lobes.fitting.search import find_node, fit
from workflows.recovery.lobes.footprint import PARAMETERS, PatternCodes
from workflows.recovery.lobes.mixture import Mixture, make_workspace
from workflows.recovery.lobes.options import FINE, LobesOptions
from workflows.recovery.pyramid import bump_variance

COLUMNS, ROWS, MOST = 64, 48, 3
SIGMA = 0.01
STILL = np.zeros(2)
OPTIONS = LobesOptions(
    most_lobes=MOST,
    fit_resolution=0.8,
    resolution=1.3,
    rounds=2,
    steps=20,
    tolerance=0.1,
    beam=6,
    doubt=0.01,
    passes=1,
    gradients=10,
    least_weight=1e-4,
)


class Fitted(NamedTuple):
    """What `fit` made of a pixel, the lobes by falling weight."""

    lobes: NDArray[np.float64]
    level: NDArray[np.int64]
    offset: NDArray[np.float64]
    kappa: float
    objective: float

    def covariance(self, i):
        """Of a lobe and its bumps."""
        root = np.array([[self.lobes[i, 3], 0], self.lobes[i, 4:]])
        return root @ root.T + bump_variance(int(self.level[i])) * np.eye(2)


@pytest.fixture(scope="module")
def patterns(patterns_of):
    return patterns_of([(8, 6, 24), (16, 12, 24), (32, 24, 24), (COLUMNS, ROWS, 24)], 1)


@pytest.fixture(scope="module")
def shown(patterns):
    return PatternCodes(
        patterns.pyramid.arrays,
        patterns.code,
        0,
        1,
        patterns.count,
        np.ones((1, patterns.count + 2), np.float32),
        False,
    )


@pytest.fixture(scope="module")
def measure(patterns):
    """Noisy measurements of T on the first grid, and their variance."""

    def of(T, seed=0, offset=0.0):
        rng = np.random.default_rng(seed)
        signed = patterns.code[: COLUMNS * ROWS] / 127.5 - 1
        y = T.reshape(-1) @ np.concatenate([signed, np.tile([-1.0, 1.0], (len(signed), 1))], axis=1)
        y += offset + SIGMA * rng.standard_normal(y.size)
        return y.astype(np.float32), np.full(y.size, SIGMA**2, np.float32)

    return of


@pytest.fixture(scope="module")
def fitted(shown):
    def run(y, variance, most=MOST):
        mixture = Mixture(np.zeros((MOST, PARAMETERS)), np.zeros(MOST, np.int64), np.zeros(1), np.zeros(2))
        k, kappa, objective = fit(
            shown, y, variance, mixture, 0, OPTIONS._replace(most_lobes=most), make_workspace(shown.m)
        )
        order = np.argsort(-mixture.lobes[:k, 0], kind="stable")
        return Fitted(mixture.lobes[order], mixture.level[order], mixture.stray, kappa, objective)

    return run


@pytest.fixture(scope="module")
def truth(gaussian):
    """(cells,) a Gaussian's shares."""
    return lambda *shape: gaussian(COLUMNS, ROWS, *shape)[0, 0]


def turned(major, minor, angle):
    """The covariance of an oriented Gaussian seen through cells."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ np.diag([major**2, minor**2]) @ turn.T + np.eye(2) / 12


@pytest.mark.parametrize(
    "shape", [(20.3, 30.8, 1.2, 1.2, 0.0), (40.0, 20.5, 3.0, 1.4, 0.7), (30.2, 22.1, 6.0, 2.5, 2.2)]
)
def test_one_lobe_is_recovered(measure, fitted, truth, shape):
    found = fitted(*measure(truth(*shape)))
    assert len(found.lobes) == 1
    assert found.lobes[0, 0] == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(found.lobes[0, 1:3], shape[:2], atol=0.1)
    expected = turned(*shape[2:])
    np.testing.assert_allclose(found.covariance(0), expected, atol=0.1 * np.trace(expected))


def test_two_lobes_are_recovered(measure, fitted, truth):
    shapes = (18.4, 12.7, 2.0, 1.0, 0.5), (45.6, 33.2, 1.5, 1.5, 0.0)
    found = fitted(*measure(0.65 * truth(*shapes[0]) + 0.35 * truth(*shapes[1])))
    assert len(found.lobes) == 2
    np.testing.assert_allclose(found.lobes[:, 0], [0.65, 0.35], atol=0.03)
    for i, shape in enumerate(shapes):
        np.testing.assert_allclose(found.lobes[i, 1:3], shape[:2], atol=0.15)
        expected = turned(*shape[2:])
        np.testing.assert_allclose(found.covariance(i), expected, atol=0.2 * np.trace(expected))


def test_two_points_far_narrower_than_a_lobe_are_found(patterns_of):
    patterns = patterns_of([(COLUMNS, ROWS, 100)], 1)
    strays = np.ones((1, patterns.count + 2), np.float32)
    shown = PatternCodes(patterns.pyramid.arrays, patterns.code, 0, 1, patterns.count, strays, False)
    signed = patterns.code[: COLUMNS * ROWS] / 127.5 - 1
    both_found = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        places = np.array([[26, 18], [29, 26]]) + rng.integers(-14, 14, 2)
        light = np.array([0.63, 0.37]) @ signed[places[:, 1] * COLUMNS + places[:, 0]]
        y = np.append(light, [-1, 1]) + SIGMA * rng.standard_normal(light.size + 2)
        mixture = Mixture(np.zeros((MOST, PARAMETERS)), np.zeros(MOST, np.int64), np.zeros(1), np.zeros(2))
        k, _, _ = fit(
            shown,
            y.astype(np.float32),
            np.full(y.size, SIGMA**2, np.float32),
            mixture,
            0,
            FINE._replace(most_lobes=MOST),
            make_workspace(shown.m),
        )
        order = np.argsort(-mixture.lobes[:k, 0], kind="stable")[:2]
        centres = mixture.lobes[order, 1:3]
        both_found += k > 1 and np.abs(centres - places - 0.5).max() < 0.6
    assert both_found >= 85  # about 28 before, with wider lobes and no search near those that are there


def test_the_offset_is_free(measure, fitted, truth):
    shape = (30.3, 20.6, 2.0, 2.0)
    found = fitted(*measure(truth(*shape), offset=0.05))
    assert found.offset[0] == pytest.approx(0.05, abs=0.01)
    np.testing.assert_allclose(found.lobes[0, 1:3], shape[:2], atol=0.1)


def test_noise_pays_for_no_second_lobe(measure, fitted, truth):
    T = truth(30.3, 20.6, 2.0, 1.5, 0.4)
    assert [len(fitted(*measure(T, seed)).lobes) for seed in range(12)] == [1] * 12
    rng = np.random.default_rng(0)
    variance = measure(T)[1]
    for _ in range(6):
        y = np.append(rng.normal(0, SIGMA, variance.size - 2), [-1, 1]).astype(np.float32)
        assert len(fitted(y, variance).lobes) == 1


def test_no_more_lobes_than_asked_for(measure, fitted, truth):
    T = 0.5 * truth(18.4, 12.7, 1.5, 1.5) + 0.5 * truth(45.6, 33.2, 1.5, 1.5)
    assert len(fitted(*measure(T), most=1).lobes) == 1


def test_what_was_not_measured_is_left_out(measure, fitted, truth):
    shape = (30.3, 20.6, 2.0, 1.5, 0.4)
    y, variance = measure(truth(*shape))
    variance[3::7] = np.inf
    plain = fitted(y, variance)
    y[3::7] = 100
    wild = fitted(y, variance)
    np.testing.assert_array_equal(wild.lobes, plain.lobes)
    assert (wild.kappa, wild.objective) == (plain.kappa, plain.objective)
    np.testing.assert_allclose(wild.lobes[0, 1:3], shape[:2], atol=0.1)


@pytest.mark.parametrize("known", ["nothing", "black and white", "one pattern"])
def test_too_few_measurements_give_one_finite_lobe(measure, fitted, truth, known):
    y, variance = measure(truth(30.3, 20.6, 2.0, 1.5))
    there = {"nothing": [], "black and white": [-2, -1], "one pattern": [0]}[known]
    variance[[i for i in range(-2, y.size - 2) if i not in there]] = np.inf
    found = fitted(y, variance)
    assert len(found.lobes) == 1
    assert np.isfinite(found.lobes).all()
    assert np.isfinite([found.kappa, found.objective]).all()


def test_find_node_finds_the_node_that_is_missing(patterns, shown):
    m, grids = patterns.count, shown.grids
    for level, column, row in ((0, 41, 17), (1, 9, 20)):
        node = grids.starts[level] + row * grids.columns[level] + column
        f = np.append(np.zeros(m), [-1, 1]).astype(np.float32)
        y = np.append(0.2 * (patterns.code[node] / 127.5 - 1), [-1, 1]).astype(np.float32)
        precision = np.full(m + 2, SIGMA**-2, np.float32)
        found = find_node(shown, y, f, precision, 6, False, STILL)
        assert found[:3] == (level, column, row)
        assert found[4] == pytest.approx(0.2, rel=1e-4)
        d = patterns.code[node] / 127.5 - 1
        z_squared = 0.04 * (d @ d) / SIGMA**2
        places = grids.columns[level] * grids.rows[level]
        assert found[3] == pytest.approx(z_squared - 2 * np.log(places), rel=1e-4)
    assert find_node(shown, f, f, precision, 6, False, STILL)[0] == -1


def test_first_node_that_explains_all_outweighs_the_wide_one_about_it(patterns_of):
    patterns = patterns_of([(8, 6, 5), (16, 12, 5), (32, 24, 5), (COLUMNS, ROWS, 5)], 1)
    few = PatternCodes(patterns.pyramid.arrays, patterns.code, 0, 1, 20, np.ones((1, 22), np.float32), False)
    y = np.append(patterns.code[17 * COLUMNS + 41] / 127.5 - 1, [-1, 1]).astype(np.float32)
    f = np.append(np.zeros(20), [-1, 1]).astype(np.float32)
    precision = np.ones(22, np.float32)  # as if nothing were explained
    level, column, row, gain, _ = find_node(few, y, f, precision, 6, True, STILL)
    assert (level, column, row) == (0, 41, 17)
    assert gain > 100  # not 20, the chi-square of 20 measurements
