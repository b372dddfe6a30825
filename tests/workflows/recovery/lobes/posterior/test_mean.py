"""The posterior mean of T against the dense closed form, and what holds for any measurements."""

import numpy as np
import pytest

from workflows.recovery.lobes.footprint import PatternCodes
from workflows.recovery.lobes.nodes import node_responses
from workflows.recovery.lobes.posterior.mean import total_variance, update
from workflows.recovery.pyramid import Pyramid

# Standard deviation of an offset.
OFFSET = 0.03
M = 50
GRIDS = Pyramid.over(8, 6).arrays
# No stray light but constant light, an offset.
CONSTANT = np.ones((1, M + 2), np.float32)
# All nodes are of one lobe.
END = np.array([40])


def problem(groups, n=40, seed=0, sigma=0.02):
    """The rows of n nodes, the weights of a first estimate, and measurements of others."""
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 256, (n, groups * M), np.uint8)
    A = np.empty((n, groups * (M + 2)), np.float32)
    node_responses(PatternCodes(GRIDS, code, 0, groups, M, CONSTANT, False), np.arange(n), n, A)
    weight, truth = rng.dirichlet(np.full(n, 5.0), 2)
    variance = np.full(groups * (M + 2), sigma**2, np.float32)
    y = truth @ A + sigma * rng.standard_normal(variance.size)
    return A, weight.astype(np.float32), y.astype(np.float32), variance, truth


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("left_out", [False, True])
def test_a_pass_is_the_closed_form(groups, left_out):
    A, weight, y, variance, _ = problem(groups)
    there = np.ones(y.size, bool)
    if left_out:
        there[3::5] = False
        variance[~there] = np.inf
        y[~there] = 100
    start, offset = weight.copy(), np.full(groups, 0.01)
    kappa, misfit = update(A, weight, END, y, variance, CONSTANT, offset, 1, 500)

    rows, t = A[:, there].astype(float), start.astype(float)
    group, of_patterns = np.divmod(np.flatnonzero(there), M + 2)
    residual = y[there] - t @ rows - 0.01
    seen = of_patterns < M
    excess = residual[seen] ** 2 - variance[there][seen]
    assert misfit == pytest.approx(excess.mean(), rel=1e-4)
    within = np.maximum(1 - t @ rows**2, 0) * seen
    K = kappa * rows.T @ (t[:, None] * rows) + np.diag(variance[there] + kappa * within)
    K += OFFSET**2 * (group[:, None] == group)
    x = np.linalg.solve(K, residual)
    mean = t * np.maximum(1 + kappa * rows @ x, 0)
    mean /= mean.sum()
    # conjugate gradients end with a thousandth or so left
    assert np.linalg.norm(weight - mean) < 0.01 * np.linalg.norm(mean - start)
    expected = 0.01 + OFFSET**2 * np.bincount(group, x, groups)
    np.testing.assert_allclose(offset, expected, atol=0.02 * np.abs(expected - 0.01).max())


def test_posterior_mean_does_not_depend_on_which_lobe_a_node_is_of():
    A, weight, y, variance, _ = problem(1)
    one, three = weight.copy(), weight.copy()
    update(A, one, END, y, variance, CONSTANT, np.zeros(1), 1, 500)
    update(A, three, np.array([7, 19, 40]), y, variance, CONSTANT, np.zeros(1), 1, 500)
    assert np.abs(one - three).sum() < 0.01 * np.abs(one - weight).sum()


def test_posterior_mean_of_a_node_does_not_depend_on_how_often_it_is_there():
    A, weight, y, variance, _ = problem(1)
    twice = np.append(weight, weight[:10])
    twice[:10], twice[-10:] = 0.3 * weight[:10], 0.7 * weight[:10]
    ends = np.array([40, 50])
    once = weight.copy()
    update(A, once, END, y, variance, CONSTANT, np.zeros(1), 2, 500)
    update(np.vstack((A, A[:10])), twice, ends, y, variance, CONSTANT, np.zeros(1), 2, 500)
    twice[:10] += twice[-10:]
    assert np.abs(once - twice[:40]).sum() < 0.01 * np.abs(once - weight).sum()


def test_more_passes_come_closer_to_the_truth():
    A, weight, y, variance, truth = problem(1, seed=3)
    errors = []
    for _ in range(3):
        errors.append(np.abs(weight - truth).sum())
        update(A, weight, END, y, variance, CONSTANT, np.zeros(1), 1, 50)
    assert errors[2] < 0.8 * errors[0]


@pytest.mark.parametrize("seed", range(6))
def test_weights_stay_shares(seed):
    A, weight, y, variance, _ = problem(1, seed=seed, sigma=0.2 if seed % 2 else 1e-4)
    if seed > 3:
        weight[::3] = 0
        weight /= weight.sum()
    empty = weight == 0
    update(A, weight, END, y, variance, CONSTANT, np.zeros(1), 4, 10)
    assert weight.min() >= 0
    assert weight.sum() == pytest.approx(1, abs=1e-5)
    assert (weight[empty] == 0).all()


def test_weights_stay_without_measurements():
    A, weight, y, variance, _ = problem(1)
    variance[:] = np.inf
    start, offset = weight.copy(), np.full(1, 0.02)
    update(A, weight, END, y, variance, CONSTANT, offset, 3, 10)
    np.testing.assert_allclose(weight, start, rtol=1e-6)
    assert offset[0] == 0.02


def test_weights_that_explain_the_measurements_stay():
    A, weight, _, variance, _ = problem(1)
    start, exact = weight.copy(), weight @ A
    update(A, weight, END, exact, variance, CONSTANT, np.zeros(1), 3, 10)
    np.testing.assert_allclose(weight, start, rtol=1e-3)


def test_total_variance_finds_the_variance_about_a_first_estimate():
    rng = np.random.default_rng(0)
    m, kappa = 20_000, 0.05
    code = 255 * rng.integers(0, 2, (6, m)).astype(np.uint8)
    A = np.empty((6, m + 2), np.float32)
    node_responses(PatternCodes(GRIDS, code, 0, 1, m, CONSTANT, False), np.arange(6), 6, A)
    weight = rng.dirichlet(np.full(6, 5.0)).astype(np.float32)
    f, variance = weight @ A, rng.uniform(1e-4, 2e-3, m + 2).astype(np.float32)
    spread = variance + kappa * np.maximum(1 - f**2, 0)
    y = (f + np.sqrt(spread) * rng.standard_normal(m + 2)).astype(np.float32)
    total = np.empty_like(y)
    found, misfit = total_variance(y, f, f, weight @ A**2, variance, 1, total)
    assert found == pytest.approx(kappa, rel=0.05)
    assert misfit == pytest.approx(np.mean((y - f)[:m] ** 2 - variance[:m]), rel=1e-4)
    # black and white nodes leave nothing to what is finer than them
    np.testing.assert_allclose(total, variance, atol=1e-7)


def test_few_steps_suffice_where_patterns_differ_little():
    """Neighbouring nodes of sharp glass: their patterns are alike, and dark values are known very well."""
    far = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        code = np.where(rng.random(M) < 0.5, 0, 255) ^ np.where(rng.random((16, M)) < 0.15, 255, 0)
        A = np.empty((16, M + 2), np.float32)
        node_responses(
            PatternCodes(GRIDS, code.astype(np.uint8), 0, 1, M, CONSTANT, False), np.arange(16), 16, A
        )
        start, truth = rng.dirichlet(np.full(16, 0.5), 2)
        y = truth @ A
        variance = np.where(y < 0, 1e-5, 2e-4)
        variance[-2:] = 1e-6
        y = (y + np.sqrt(variance) * rng.standard_normal(y.size)).astype(np.float32)
        few, many = start.astype(np.float32), start.astype(np.float32)
        for weight, steps in ((few, 9), (many, 500)):
            update(A, weight, np.array([16]), y, variance.astype(np.float32), CONSTANT, np.zeros(1), 2, steps)
        far += np.abs(few - many).sum() > 0.6
    assert far <= 3
