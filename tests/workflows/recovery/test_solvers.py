import numpy as np
import pytest
from scipy.optimize import nnls

from workflows.recovery.solvers import descend, inner, signed_rows


@pytest.mark.parametrize(("s", "m"), [(6, 20), (30, 40), (40, 30)])
def test_descend_is_non_negative_least_squares(s, m):
    rng = np.random.default_rng(s)
    matrix = np.sign(rng.standard_normal((s, m))).astype(np.float32)
    truth = np.where(rng.random(s) < 0.3, rng.random(s), 0)
    target = (truth @ matrix + 0.05 * rng.standard_normal(m)).astype(np.float32)
    x = rng.random(s).astype(np.float32)
    residual = descend(matrix, target, x, 5000, 1e-7)
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
    descend(matrix, np.full(3, 0.5, np.float32), x, 10, 0.0)
    np.testing.assert_array_equal(x, [0.25, 0.5])


def test_descend_without_cells_returns_the_target():
    target = np.ones(3, np.float32)
    residual = descend(np.empty((0, 3), np.float32), target, np.empty(0, np.float32), 10, 0.0)
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
