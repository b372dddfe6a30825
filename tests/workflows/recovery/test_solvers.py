import numpy as np
import pytest
from scipy.optimize import nnls

from workflows.recovery.solvers import inner, posterior_mean, signed_rows, solve_nnls, stack_rows


@pytest.mark.parametrize(("s", "m"), [(6, 20), (30, 40), (40, 30)])
def test_descend_is_non_negative_least_squares(s, m):
    rng = np.random.default_rng(s)
    matrix = np.sign(rng.standard_normal((s, m))).astype(np.float32)
    truth = np.where(rng.random(s) < 0.3, rng.random(s), 0)
    target = (truth @ matrix + 0.05 * rng.standard_normal(m)).astype(np.float32)
    x = rng.random(s).astype(np.float32)
    residual = solve_nnls(matrix, target, x, 5000, 1e-7)
    expected, norm = nnls(matrix.T.astype(float), target.astype(float))
    assert np.linalg.norm(target - x @ matrix) == pytest.approx(norm, abs=1e-3)
    if s < m:
        np.testing.assert_allclose(x, expected, atol=2e-3)
    np.testing.assert_allclose(residual, target - x @ matrix, atol=1e-4)
    assert (x >= 0).all()


def test_descend_leaves_what_no_measurement_sees():
    matrix = np.zeros((2, 3), np.float32)
    matrix[1] = 1
    x = np.array([0.25, 0], np.float32)
    solve_nnls(matrix, np.full(3, 0.5, np.float32), x, 10, 0.0)
    np.testing.assert_array_equal(x, [0.25, 0.5])


def test_descend_without_cells_returns_the_target():
    target = np.ones(3, np.float32)
    residual = solve_nnls(np.empty((0, 3), np.float32), target, np.empty(0, np.float32), 10, 0.0)
    np.testing.assert_array_equal(residual, target)


def test_inner_is_the_dot_product():
    rng = np.random.default_rng(0)
    for size in (0, 1, 7, 124, 275):
        a, b = rng.standard_normal((2, size)).astype(np.float32)
        assert inner(a, b) == pytest.approx(float(a.astype(float) @ b), abs=1e-4)


def test_signed_rows_scale_each_measurement():
    rng = np.random.default_rng(0)
    light = rng.random((5, 4)).astype(np.float32)
    cell, scale = np.array([3, 1], np.int32), rng.random(4).astype(np.float32)
    out = np.zeros((2, 6), np.float32)
    signed_rows(light, cell, scale, 1, out)
    np.testing.assert_allclose(out[:, 1:5], scale * (2 * light[cell] - 1), rtol=1e-6)
    assert (out[:, [0, 5]] == 0).all()


def test_stacked_rows_are_the_channels_one_after_another():
    rng = np.random.default_rng(0)
    light = rng.random((3, 5, 4)).astype(np.float32)
    cell, scale = np.array([3, 1], np.int32), rng.random(12).astype(np.float32)
    out = np.empty((2, 12), np.float32)
    stack_rows(light, cell, scale, out)
    expected = (2 * light[:, cell] - 1).transpose(1, 0, 2).reshape(2, 12)
    np.testing.assert_allclose(out, scale * expected, rtol=1e-6)


def test_posterior_mean_is_the_closed_form():
    rng = np.random.default_rng(0)
    matrix = np.sign(rng.standard_normal((40, 25))).astype(np.float32)
    mean = rng.dirichlet(np.full(40, 5.0)).astype(np.float32)
    target = rng.dirichlet(np.full(40, 5.0)) @ matrix
    variance, prior_scale = 1e-3, 0.02
    gram = prior_scale * (matrix.T * mean) @ matrix + variance * np.eye(25)
    gain = prior_scale * mean * (matrix @ np.linalg.solve(gram, target - mean @ matrix))
    residual = (target - mean @ matrix).astype(np.float32)
    found = posterior_mean(matrix, residual, mean, variance, prior_scale, 200, 1e-6)
    np.testing.assert_allclose(found, np.maximum(mean + gain, 0), atol=2e-5)
    assert (posterior_mean(matrix, residual, mean, variance, 0.0, 200, 1e-6) == mean).all()


def test_posterior_mean_without_light_is_the_prior():
    mean = np.full(3, 1 / 3, np.float32)
    found = posterior_mean(np.zeros((3, 4), np.float32), np.ones(4, np.float32), mean, 0.0, 1.0, 10, 0.0)
    np.testing.assert_array_equal(found, mean)
