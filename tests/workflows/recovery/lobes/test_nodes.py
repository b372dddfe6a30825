"""Lobes spread over nodes are seen where they are, and gathered they are the same again."""

import numpy as np
import pytest

from workflows.recovery.lobes.footprint import NODES, PARAMETERS, PatternCodes
from workflows.recovery.lobes.mixture import Mixture
from workflows.recovery.lobes.nodes import gather_lobes, merge_nodes, node_responses, spread_lobes
from workflows.recovery.pyramid import Pyramid

M = 50
PYRAMID = Pyramid.over(64, 48)
GRIDS = PYRAMID.arrays


@pytest.mark.parametrize("groups", [1, 3])
def test_rows_are_the_signed_codes_between_black_and_white(groups):
    code = np.random.default_rng(0).integers(0, 256, (9, 2 + groups * M), np.uint8)
    node = np.array([7, 0, 3, 3])
    A = np.full((4, groups * (M + 2)), np.nan, np.float32)
    node_responses(
        PatternCodes(GRIDS, code, 2, groups, M, np.ones((1, M + 2), np.float32), False), node, 3, A
    )
    assert np.isnan(A[3]).all()
    A = A[:3]
    for g in range(groups):
        of_group = A[:, g * (M + 2) : (g + 1) * (M + 2)]
        np.testing.assert_allclose(of_group[:, :M], code[node[:3], 2 + g * M :][:, :M] / 127.5 - 1, atol=1e-6)
        np.testing.assert_array_equal(of_group[:, M:], [[-1, 1]] * 3)


def test_lobes_are_spread_by_their_weights():
    lobes = np.array([[0.6, 20, 15, 1.5, 0, 1.5], [0.3, 21, 16, 2, 0, 2], [7, 1, 1, 1, 0, 1]], float)
    level = np.zeros(3, np.int64)
    node, weight = np.empty(3 * NODES, np.int64), np.empty(3 * NODES, np.float32)
    assert lobes.shape[1] == PARAMETERS
    end = np.zeros(3, np.int64)
    n = spread_lobes(GRIDS, Mixture(lobes, level, np.zeros(1), np.zeros(2)), 2, 0.8, node, weight, end)
    assert n == end[1]
    assert weight[:n].sum() == pytest.approx(1, abs=1e-5)
    y, x = np.mgrid[:48, :64] + 0.5
    light = PYRAMID.light(np.stack([x, y], axis=2))[node[:n]]
    assert weight[: end[0]].sum() == pytest.approx(0.6 / 0.9, abs=1e-5)
    for part, centre in ((slice(end[0]), (20, 15)), (slice(end[0], n), (21, 16))):
        np.testing.assert_allclose(weight[part] @ light[part] / weight[part].sum(), centre, atol=0.02)


def test_a_node_is_left_to_the_first_of_its_lobes_unless_it_has_little():
    lobes = np.array([[0.5, 20, 15, 1.5, 0, 1.5], [0.001, 50, 40, 1.2, 0, 1.2], [0.3, 21, 16, 1.4, 0.3, 1.4]])
    end, seen = np.zeros(3, np.int64), np.zeros(PYRAMID.nodes, np.int32)
    node, weight = np.empty(3 * NODES, np.int64), np.empty(3 * NODES, np.float32)
    n = spread_lobes(
        GRIDS, Mixture(lobes, np.zeros(3, np.int64), np.zeros(1), np.zeros(2)), 3, 0.8, node, weight, end
    )
    total = np.bincount(node[:n], weight[:n], PYRAMID.nodes)
    first = {}
    for lobe, nodes in enumerate(np.split(node[:n], end[:2])):
        for at in nodes[total[nodes] >= 3e-5].tolist():
            first.setdefault(at, lobe)

    merged = merge_nodes(node, weight, end, 3, seen)
    assert merged == end[2] == len(first) < len(np.unique(node[:n])) < n
    left = np.bincount(node[:merged], weight[:merged], PYRAMID.nodes)
    np.testing.assert_allclose(left, np.where(total >= 3e-5, total, 0), atol=1e-6)
    for lobe, nodes in enumerate(np.split(node[:merged], end[:2])):
        assert nodes.tolist() == [at for at, of in first.items() if of == lobe]
    assert not seen.any()


def test_gathered_lobes_are_those_that_were_spread():
    lobes = np.array([[0.7, 20, 15, 2.5, 1, 1.8], [0.3, 41, 30, 3, -2, 2.2]])
    level, end = np.zeros(2, np.int64), np.zeros(2, np.int64)
    node, weight = np.empty(2 * NODES, np.int64), np.empty(2 * NODES, np.float32)
    n = spread_lobes(GRIDS, Mixture(lobes, level, np.zeros(1), np.zeros(2)), 2, 1.1, node, weight, end)
    found = Mixture(lobes + 1.0, level.copy(), np.zeros(1), np.zeros(2))
    gather_lobes(GRIDS, node, weight, end, found, 2, 1.1)
    np.testing.assert_array_equal(found.level, level)
    # what is beyond the reach of a lobe is a few per cent of its covariance
    np.testing.assert_allclose(found.lobes, lobes, rtol=0.05, atol=0.02)

    weight[:n] *= np.where(node[:n] % 64 < 20, 1, 0)
    gather_lobes(GRIDS, node, weight, end, found, 2, 1.1)
    assert found.lobes[0, 1] < 20
    # nothing is left of the second: it stays where it is
    assert found.lobes[1, 0] < 1e-6
    np.testing.assert_allclose(found.lobes[1, 1:], lobes[1, 1:], rtol=0.05, atol=0.02)
