"""The small linear systems of the lobes' steps, against numpy."""

import numpy as np
import pytest

from workflows.recovery.lobes.fitting.levenberg_marquardt import solve


@pytest.mark.parametrize("n", [1, 7, 25])
def test_solve_is_numpys(n):
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n + 3))
    A, b = root @ root.T, rng.standard_normal(n)
    x = b.copy()
    assert solve(A.copy(), x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8)
    A[-1, -1] -= 2 * np.trace(A)
    assert not solve(A, b)
