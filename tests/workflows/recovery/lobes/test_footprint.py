"""A lobe on the nodes of a pyramid: its moments, its derivatives, the level it lies on, and its bounds."""

import numpy as np
import pytest

from workflows.recovery.lobes.footprint import (
    NODES,
    PARAMETERS,
    combine,
    fit_level,
    sample,
    signed_codes,
)
from workflows.recovery.pyramid import Pyramid, bump_variance

COLUMNS, ROWS = 128, 96
PYRAMID = Pyramid.over(COLUMNS, ROWS)
GRIDS = PYRAMID.arrays
SHAPES = [(60.3, 41.8, 3.0, 0.0, 3.0), (70.6, 50.1, 2.5, 2.0, 4.0), (50.0, 44.5, 6.0, -3.0, 1.5)]


def lobe_of(x, y, l00, l10, l11, weight=1.0):
    return np.array([weight, x, y, l00, l10, l11])


def sampled(lobe, level, terms=PARAMETERS):
    node, out = np.empty(NODES, np.int64), np.empty((terms, NODES), np.float32)
    n = sample(lobe, level, GRIDS, node, out)
    assert 1 <= n <= NODES
    return node[:n], out[:, :n]


def places(node, level):
    """(n, 2) the centres of nodes of a level."""
    at = node - PYRAMID.starts[level]
    assert (at >= 0).all()
    assert (at < np.prod(PYRAMID.grids[level])).all()
    wide = PYRAMID.grids[level][0]
    return (np.stack([at % wide, at // wide], axis=1) + 0.5) * 2**level


def covariance(lobe):
    root = np.array([[lobe[3], 0], [lobe[4], lobe[5]]])
    return root @ root.T


def moments(node, share):
    """Centre and covariance of what the nodes see, from the light of polynomials on the first grid."""
    y, x = np.mgrid[:ROWS, :COLUMNS] + 0.5
    # the mean of x^2 over a cell is 1/12 more than the square of its middle
    light = PYRAMID.light(np.stack([x, y, x * x + 1 / 12, x * y, y * y + 1 / 12], axis=2))
    x, y, xx, xy, yy = share.astype(float) @ light[node]
    return np.array([x, y]), np.array([[xx - x * x, xy - x * y], [xy - x * y, yy - y * y]])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("level", [0, 1])
def test_a_sampled_lobe_has_the_moments_of_its_gaussian_and_of_its_bumps(shape, level):
    lobe = lobe_of(*shape)
    node, terms = sampled(lobe, level)
    assert terms[0].sum() == pytest.approx(1, abs=1e-5)
    assert np.unique(node).size == node.size
    centre, spread = moments(node, terms[0])
    np.testing.assert_allclose(centre, lobe[1:3], atol=0.02 * 2**level)
    expected = covariance(lobe) + bump_variance(level) * np.eye(2)
    # what is cut off makes it narrower by 3.4 %
    np.testing.assert_allclose(spread, expected, atol=0.05 * np.trace(expected))


@pytest.mark.parametrize("level", range(3))
def test_bump_variance_is_that_of_a_node(level):
    node = np.array([PYRAMID.starts[level] + 12 * PYRAMID.grids[level][0] + 16])
    centre, spread = moments(node, np.ones(1))
    np.testing.assert_allclose(centre, np.array([16.5, 12.5]) * 2**level, rtol=1e-6)
    np.testing.assert_allclose(spread, bump_variance(level) * np.eye(2), atol=0.01)


@pytest.mark.parametrize("shape", SHAPES)
def test_derivatives_are_finite_differences(shape):
    level = 1
    lobe = lobe_of(*shape)
    node, terms = sampled(lobe, level)

    def shares(parameters):
        """On the same nodes: which ones are cut off is not for derivatives to know."""
        root = np.array([[parameters[3], 0], [parameters[4], parameters[5]]])
        z = np.linalg.solve(root, (places(node, level) - parameters[1:3]).T)
        share = np.exp(-(z**2).sum(axis=0) / 2)
        return share / share.sum()

    np.testing.assert_allclose(terms[0], shares(lobe), atol=1e-6)
    for t in range(1, PARAMETERS):
        by = 1e-5 * np.eye(PARAMETERS)[t]
        expected = (shares(lobe + by) - shares(lobe - by)) / 2e-5
        np.testing.assert_allclose(terms[t], expected, atol=1e-3 * np.abs(expected).max())
        assert abs(terms[t].sum()) < 1e-5


@pytest.mark.parametrize(
    "shape", [(-6.0, 40.0, 5.0, 2.0, 4.0), (64.2, 97.0, 0.7, 0.9, 0.6), (60, 40, 30, 28, 2.0)]
)
def test_shares_of_cut_and_slanted_lobes_are_those_of_the_plain_form(shape):
    lobe = lobe_of(*shape)
    node, terms = sampled(lobe, 0)
    z = np.linalg.solve(np.array([[shape[2], 0], shape[3:]]), (places(node, 0) - shape[:2]).T)
    share = np.exp(-(z**2).sum(axis=0) / 2)
    np.testing.assert_allclose(terms[0], share / share.sum(), rtol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_node_within_reach_is_sampled(shape):
    lobe = lobe_of(*shape)
    node, _ = sampled(lobe, 0, terms=1)
    y, x = np.mgrid[:ROWS, :COLUMNS].reshape(2, -1) + 0.5
    z = np.linalg.solve(np.linalg.cholesky(covariance(lobe)), [x - lobe[1], y - lobe[2]])
    np.testing.assert_array_equal(node, np.flatnonzero((z**2).sum(axis=0) <= 10))


@pytest.mark.parametrize("resolution", [0.8, 1.3])
@pytest.mark.parametrize("shape", [*SHAPES, (40.0, 40.0, 5.0, 4.0, 5.0), (40.0, 40.0, 9.0, -5.0, 8.0)])
def test_a_lobe_goes_to_the_level_that_resolves_it_and_stays_as_wide(shape, resolution):
    lobe = lobe_of(*shape, weight=0.5)
    before = covariance(lobe) + bump_variance(0) * np.eye(2)
    level = fit_level(lobe, 0, GRIDS.columns, resolution)
    minor = np.sqrt(np.linalg.eigvalsh(before)[0])
    assert level == 0 or minor >= resolution * 2**level
    assert minor < 2 * resolution * 2**level or level == len(PYRAMID.grids) - 1
    after = covariance(lobe) + bump_variance(level) * np.eye(2)
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(lobe[:3], [0.5, *shape[:2]])
    again = lobe.copy()
    assert fit_level(again, level, GRIDS.columns, resolution) == level
    np.testing.assert_allclose(again, lobe, rtol=1e-6, atol=1e-9)


def test_levels_differ():
    assert [fit_level(lobe_of(40, 40, s, 0, s), 0, GRIDS.columns, 1.3) for s in (1, 4, 9)] == [0, 1, 2]


def test_a_lobe_too_narrow_for_its_nodes_is_widened():
    lobe = lobe_of(40.0, 40.0, 0.01, 0.5, 0.01)
    assert fit_level(lobe, 0, GRIDS.columns, 0.8) == 0
    np.testing.assert_allclose(np.linalg.eigvalsh(covariance(lobe))[0], 0.5**2, rtol=1e-6)
    # and does not fall between them
    for lobe[1] in np.arange(40, 41, 0.125):
        node, terms = sampled(lobe, 0, terms=1)
        centre, _ = moments(node, terms[0])
        np.testing.assert_allclose(centre, lobe[1:3], atol=0.05)


@pytest.mark.parametrize("shape", [(64.0, 48.0, 60.0, 50.0, 3.0), (64.0, 48.0, 200.0, 0.0, 150.0)])
def test_never_more_nodes_than_there_is_room_for(shape):
    lobe = lobe_of(*shape)
    crowded, _ = sampled(lobe, 0)
    assert crowded.size == NODES
    level = fit_level(lobe, 0, GRIDS.columns, 0.8)
    assert level > 0
    node, terms = sampled(lobe, level)
    assert terms[0].sum() == pytest.approx(1, abs=1e-5)
    places(node, level)


@pytest.mark.parametrize(
    ("x", "y", "column", "row"),
    [(-20, 40, 0, 20), (148, 40, 63, 20), (60, -20, 30, 0), (60, 116, 30, 47), (-20, -20, 0, 0)],
)
def test_a_lobe_outside_the_monitor_is_one_node_at_the_edge(x, y, column, row):
    node, terms = sampled(lobe_of(x, y, 2, 0.5, 2), 1)
    np.testing.assert_array_equal(node, [PYRAMID.starts[1] + row * 64 + column])
    np.testing.assert_array_equal(terms[:, 0], [1, 0, 0, 0, 0, 0])


def test_load_and_combine_are_a_product_of_matrices():
    rng = np.random.default_rng(0)
    code = rng.integers(0, 256, (PYRAMID.nodes, 40), np.uint8)
    node, terms = sampled(lobe_of(*SHAPES[0]), 1)
    n = node.size
    rows, out = np.empty((NODES, 33), np.float32), np.empty((PARAMETERS, 33), np.float32)
    signed_codes(code, 5, 33, node, n, rows, 0)
    signed = code[node, 5:38] / 127.5 - 1
    np.testing.assert_allclose(rows[:n], signed, atol=1e-6)
    for kept in (n, n - 1, n - 2, 3, 1):
        shares = terms[:, :kept] - terms[:, :kept].mean(axis=1, keepdims=True)
        shares[0] += 1 / kept
        for count in (PARAMETERS, 1):
            combine(code, 5, 33, node, kept, shares[:count], out[:count])
            np.testing.assert_allclose(out[:count], shares[:count].astype(float) @ signed[:kept], atol=1e-5)
