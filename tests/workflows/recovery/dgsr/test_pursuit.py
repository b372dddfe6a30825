"""The search of NN-DGSR: proxies, groups, and measurements that are left out."""

import numpy as np
import pytest

from workflows.recovery.dgsr.groups import Rows
from workflows.recovery.dgsr.options import Constants
from workflows.recovery.dgsr.pursuit import System, choose_groups, correlate, grow_rows

COLUMNS, ROWS = 8, 6


@pytest.mark.parametrize("channels", [1, 3])
def test_proxies_are_the_inner_products_with_the_signed_rows(channels):
    rng = np.random.default_rng(channels)
    light = rng.random((channels, 20, 7)).astype(np.float32)
    cell = np.array([4, 0, 19], np.int32)
    scale, residual = rng.standard_normal((2, channels * 7)).astype(np.float32)
    out = np.empty(3, np.float32)
    correlate(light, cell, scale, residual, out)
    signed = (2 * light[:, cell] - 1).transpose(1, 0, 2).reshape(3, -1)
    np.testing.assert_allclose(out, signed @ (scale * residual), atol=1e-5)


def chosen(values, k):
    cell = np.arange(COLUMNS * ROWS, dtype=np.int32)
    value, out = np.zeros(cell.size, np.float32), np.empty(cell.size, np.bool_)
    for (column, row), weight in values.items():
        value[row * COLUMNS + column] = weight
    choose_groups(cell, value, k, COLUMNS, np.zeros((ROWS + 2, COLUMNS + 2), np.float32), out)
    return {(c % COLUMNS, c // COLUMNS) for c in np.flatnonzero(out)}


def test_a_group_outweighs_a_lone_cell():
    values = {(1, 1): 0.5, (2, 1): 0.5, (2, 2): 0.5, (6, 4): 0.6}
    assert chosen(values, 3) == {(1, 1), (2, 1), (2, 2)}
    assert chosen(values, 4) == set(values)


def test_what_is_not_above_zero_is_never_chosen():
    assert chosen({(1, 1): 0.5}, 10) == {(1, 1)}


def test_of_equal_cells_the_first_are_chosen():
    assert chosen({(6, 0): 0.5, (1, 3): 0.5, (5, 5): 0.5}, 2) == {(6, 0), (1, 3)}


@pytest.mark.parametrize("finest", [True, False])
def test_measurements_of_scale_zero_change_nothing(finest):
    rng = np.random.default_rng(1)
    light = rng.integers(0, 2, (1, COLUMNS * ROWS, 40)).astype(np.float32)
    truth = np.zeros(COLUMNS * ROWS, np.float32)
    truth[[9, 30]] = [0.7, 0.3]
    scale = np.ones((2, 40), np.float32)
    scale[1, ::4] = 0
    target = scale * (truth @ (2 * light[0] - 1))
    source, variance = np.zeros(2, np.int64), np.ones(2)
    system = System(light, COLUMNS, ROWS, source, scale, target.astype(np.float32), variance)
    found = Rows(
        np.array([0, truth.size, 2 * truth.size]),
        np.tile(np.arange(truth.size, dtype=np.int32), 2),
        np.empty(2 * truth.size, np.float32),
    )
    grow_rows(system, found, finest, Constants())
    np.testing.assert_allclose(found.weight.reshape(2, -1), [truth, truth], atol=0.01)
