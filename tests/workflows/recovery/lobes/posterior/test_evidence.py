"""The evidence for a T against the dense normal density of the measurements."""

import numpy as np
import pytest

from tests.workflows.recovery.lobes.posterior.test_mean import CONSTANT, OFFSET, M, problem
from workflows.recovery.lobes.posterior.evidence import log_evidence
from workflows.recovery.lobes.posterior.mean import update


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("nodes", [1, 40, 200])
@pytest.mark.parametrize("left_out", [False, True])
def test_is_the_dense_density(groups, nodes, left_out):
    A, weight, y, variance, _ = problem(groups, nodes)
    there = np.ones(y.size, bool)
    if left_out:
        there[3::5] = False
        variance[~there] = np.inf
        y[~there] = 100
    offset = np.full(groups, 0.01)
    found = log_evidence(A, weight, y, variance, CONSTANT, offset)

    kappa, _ = update(A, weight.copy(), np.array([nodes]), y, variance, CONSTANT, offset.copy(), 1, 1)
    rows, t = A[:, there].astype(float), weight.astype(float)
    group, of_patterns = np.divmod(np.flatnonzero(there), M + 2)
    within = np.maximum(1 - t @ rows**2, 0) * (of_patterns < M)
    K = kappa * rows.T @ (t[:, None] * rows) + np.diag(variance[there] + kappa * within)
    K += OFFSET**2 * (group[:, None] == group)
    residual = y[there] - t @ rows - 0.01
    expected = residual @ np.linalg.solve(K, residual) + np.linalg.slogdet(K)[1]
    assert found == pytest.approx(expected, rel=1e-4)


def test_the_nodes_that_light_came_from_are_more_likely():
    A, weight, y, variance, truth = problem(1)
    offset = np.zeros(1)
    near = (0.5 * weight + 0.5 * truth).astype(np.float32)
    there = log_evidence(A, near, y, variance, CONSTANT, offset)
    elsewhere = log_evidence(A, np.roll(near, 20), y, variance, CONSTANT, offset)
    assert there < elsewhere - 10
