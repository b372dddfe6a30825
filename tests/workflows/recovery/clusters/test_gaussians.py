"""Clusters of cells, and the mass of their Gaussians on cells."""

import numpy as np
import pytest

from workflows.recovery.clusters.gaussians import (
    CELL_VARIANCE,
    PARAMETERS,
    add_moments,
    integrate_gaussians,
    merge_clusters,
)

COLUMNS, ROWS = 32, 24
COLUMN = np.arange(ROWS * COLUMNS) % COLUMNS


def moments_of(weight, x, y, major, minor, angle):
    """Raw moments of an oriented Gaussian seen through cells."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    (xx, xy), (_, yy) = turn @ np.diag([major**2, minor**2]) @ turn.T + CELL_VARIANCE * np.eye(2)
    return weight * np.array([1, x, y, xx + x * x, xy + x * y, yy + y * y])


def exact(x, y, major, minor, angle, fine=8):
    """An oriented Gaussian's mass on each cell, summed over a finer grid."""
    v, u = (np.mgrid[: ROWS * fine, : COLUMNS * fine] + 0.5) / fine
    along = (u - x) * np.cos(angle) + (v - y) * np.sin(angle)
    across = (v - y) * np.cos(angle) - (u - x) * np.sin(angle)
    dense = np.exp(-((along / major) ** 2 + (across / minor) ** 2) / 2) / (
        2 * np.pi * major * minor * fine**2
    )
    return dense.reshape(ROWS, fine, COLUMNS, fine).sum((1, 3)).ravel()


def dense_of(cell, mass):
    out = np.zeros(ROWS * COLUMNS)
    out[cell] = mass
    return out


def raw(cells):
    """One cluster a cell, from (column, row, weight)."""
    moments = np.zeros((len(cells), PARAMETERS))
    for row, (x, y, weight) in zip(moments, cells, strict=True):
        add_moments(row, y * COLUMNS + x, COLUMNS, weight)
    return moments


@pytest.mark.parametrize(
    "shape", [(17.3, 9.6, 3.0, 0.6, 0.5), (12.0, 12.5, 0.5, 0.4, 2.0), (20.1, 14.9, 2.0, 0.4, np.pi / 4)]
)
def test_mass_is_the_integral_over_each_cell(shape):
    field = np.zeros((3, ROWS, COLUMNS), np.float32)
    cell, mass = integrate_gaussians(moments_of(1.0, *shape)[None], COLUMNS, 6.0, field)
    assert (np.diff(cell) > 0).all()
    assert np.abs(dense_of(cell, mass[0]) - exact(*shape)).sum() < 0.01
    assert (field == 0).all()


def test_masses_keep_their_weights_and_end_at_the_reach():
    field = np.zeros((2, ROWS, COLUMNS), np.float32)
    moments = np.stack([moments_of(0.6, 6, 6, 1.5, 1, 0.3), moments_of(0.2, 25, 18, 1, 1, 0)])
    cell, mass = integrate_gaussians(moments, COLUMNS, 3.0, field)
    np.testing.assert_allclose(mass.sum(1), [0.75, 0.25], atol=0.005)
    x, y = cell % COLUMNS + 0.5, cell // COLUMNS + 0.5
    assert np.hypot(x - 25, y - 18)[mass[1] > 0].max() < 3 * np.sqrt(2) + 1
    assert np.hypot(x - 25, y - 18)[mass[0] > 0].min() > 10


def test_a_gaussian_past_the_edge_has_all_its_mass_on_the_monitor():
    field = np.zeros((1, ROWS, COLUMNS), np.float32)
    cell, mass = integrate_gaussians(moments_of(1.0, 0.4, 23.8, 2, 1, 1.0)[None], COLUMNS, 3.0, field)
    assert (cell >= 0).all()
    assert (cell < ROWS * COLUMNS).all()
    assert mass.sum() == pytest.approx(1, abs=1e-5)


def test_cluster_of_one_cell_is_as_wide_as_a_cell():
    field = np.zeros((1, ROWS, COLUMNS), np.float32)
    cell, mass = integrate_gaussians(raw([(7, 5, 1.0)]), COLUMNS, 3.0, field)
    expected = exact(7.5, 5.5, CELL_VARIANCE**0.5, CELL_VARIANCE**0.5, 0.0, fine=64)
    assert np.abs(dense_of(cell, mass[0]) - expected).sum() < 0.01


def test_clusters_are_what_lies_together():
    left, right = [(3, 4, 0.2), (4, 4, 0.3), (6, 5, 0.1)], [(25, 20, 0.1), (27, 19, 0.3)]
    moments = raw([left[0], right[0], left[1], right[1], left[2]])
    assert merge_clusters(moments, 5, 2) == 2
    found = moments[:2][np.argsort(moments[:2, 1] / moments[:2, 0])]
    np.testing.assert_allclose(found, [raw(left).sum(0), raw(right).sum(0)])


def test_fewer_clusters_than_allowed_stay():
    moments = raw([(3, 4, 0.2), (4, 4, 0.3)])
    assert merge_clusters(moments, 2, 3) == 2
    np.testing.assert_array_equal(moments, raw([(3, 4, 0.2), (4, 4, 0.3)]))
