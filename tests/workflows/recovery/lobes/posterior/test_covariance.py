"""The approximate inverse and the solution of the measurements' covariance, against plain numpy forms."""

import numpy as np
import pytest

from workflows.recovery.lobes.posterior.covariance import (
    Covariance,
    Preconditioner,
    Steps,
    precondition,
    solve_covariance,
    stray_variance,
)

M = 60
KAPPA = 0.01


def problem(groups, count, sigma=0.01, left_out=False, seed=0):
    """K of two narrow lobes, whose nodes respond nearly alike, and its parts by lobe."""
    rng = np.random.default_rng(seed)
    size = groups * (M + 2)
    of_lobe = np.where(rng.random((2, size)) < 0.5, -1, 1)
    end = np.array([23, 40])
    A = np.where(rng.random((40, size)) < 0.1, -1, 1) * np.repeat(of_lobe, [23, 17], axis=0)
    weight = rng.dirichlet(np.full(40, 5.0))
    measured = np.ones(size, bool)
    measured[1::7] = not left_out
    strays = np.concatenate([np.ones((1, M + 2)), rng.standard_normal((count - 1, M + 2))])
    noise = np.where(measured, sigma**2 * rng.uniform(0.5, 2, size), 0)
    K = Covariance(*(part.astype(np.float32) for part in (A, weight)), KAPPA, noise.astype(np.float32),
                   strays.astype(np.float32), measured)  # fmt: skip
    sums = np.stack(
        [
            part_of @ rows
            for part_of, rows in zip(np.split(weight, end[:1]), np.split(A, end[:1]), strict=True)
        ]
    )
    share = np.array([part.sum() for part in np.split(weight, end[:1])])
    return K, sums.astype(np.float32), share, (weight @ A**2).astype(np.float32)


def stray_rows(K):
    """The rows of stray light of all groups, times their standard deviations."""
    deviations = np.sqrt([stray_variance(s) for s in range(len(K.strays))])
    return np.kron(np.eye(K.noise.size // (M + 2)), deviations[:, np.newaxis] * K.strays)


def dense(K):
    """K where something was measured."""
    rows = np.concatenate([np.sqrt(KAPPA * K.weight.astype(float))[:, np.newaxis] * K.A, stray_rows(K)])
    rows = rows[:, K.measured]
    return rows.T @ rows + np.diag(K.noise[K.measured].astype(float))


def nearly(K, sums, share, square):
    """The matrix whose inverse is to be approximated: lobes as a whole, and the diagonal of the rest."""
    lobes = np.sqrt(KAPPA / share)[:, np.newaxis] * sums
    rows = np.concatenate([lobes, stray_rows(K)])[:, K.measured]
    rest = K.noise + KAPPA * square - (lobes**2).sum(axis=0)
    return rows.T @ rows + np.diag(rest[K.measured])


def empty(K, lobes):
    rank = lobes + K.noise.size // (M + 2) * len(K.strays)
    return Preconditioner(
        np.full((rank, K.noise.size), np.nan, np.float32),
        np.full(K.noise.size, np.nan, np.float32),
        np.full((rank, rank), np.nan),
        np.ones(rank, np.float32),
    )


def solve(K, approximate, most, r):
    """The solution of `most` steps or more, and the number of steps."""
    x = np.empty_like(K.noise)
    steps = Steps(r.astype(np.float32), *(np.empty_like(x) for _ in range(3)))
    taken = solve_covariance(K, approximate, most, steps, x)
    return x, taken


def some_residual(K):
    return np.where(K.measured, np.random.default_rng(1).standard_normal(K.noise.size), 0)


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("left_out", [False, True])
def test_approximate_inverse_is_that_of_lobes_and_a_diagonal(groups, count, left_out):
    K, *of_lobes = problem(groups, count, left_out=left_out)
    approximate = empty(K, 2)
    precondition(K, *of_lobes, approximate)
    found = np.diag(approximate.inverse.astype(float)) - approximate.rows.T.astype(float) @ approximate.rows
    there = np.ix_(K.measured, K.measured)
    expected = np.linalg.inv(nearly(K, *of_lobes))
    np.testing.assert_allclose(found[there], expected, atol=1e-4 * np.abs(expected).max())
    found[there] = 0
    assert (found == 0).all()
    np.testing.assert_allclose(np.diag(nearly(K, *of_lobes)), np.diag(dense(K)), rtol=1e-5)


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("left_out", [False, True])
def test_solution_is_that_of_a_direct_solve(groups, left_out):
    K, *of_lobes = problem(groups, 2, left_out=left_out)
    approximate = empty(K, 2)
    precondition(K, *of_lobes, approximate)
    r = some_residual(K)
    x, _ = solve(K, approximate, 100, r)
    expected = np.zeros(r.size)
    expected[K.measured] = np.linalg.solve(dense(K), r[K.measured])
    assert np.linalg.norm(x - expected) < 0.02 * np.linalg.norm(expected)


def test_a_lobe_without_light_is_left_out():
    K, sums, share, square = problem(1, 1)
    alone, beside = empty(K, 2), empty(K, 3)
    precondition(K, sums, share, square, alone)
    none = np.zeros((1, sums.shape[1]), np.float32)
    precondition(K, np.concatenate([sums, none]), np.append(share, 0.0), square, beside)
    np.testing.assert_array_equal(beside.inverse, alone.inverse)
    assert (beside.rows[2] == 0).all()
    np.testing.assert_allclose(beside.rows[[0, 1, 3]], alone.rows, rtol=1e-5)


def test_identical_lobes_of_a_quiet_camera_leave_the_solver_stable():
    """Rounding must not leave the Woodbury matrix without a Cholesky factor."""
    K, sums, share, square = problem(1, 1, sigma=1e-4)
    K = K._replace(A=np.repeat(np.sign(sums[:1]), 40, axis=0))
    sums = np.repeat(np.sign(sums[:1]), 2, axis=0) * share[:, np.newaxis].astype(np.float32)
    approximate = empty(K, 2)
    precondition(K, sums, share, np.ones_like(square), approximate)
    x, _ = solve(K, approximate, 9, some_residual(K))
    assert np.isfinite(approximate.rows).all()
    assert np.isfinite(x).all()


def test_steps_end_where_rounding_leaves_nothing_of_the_covariance():
    K, *_ = problem(1, 1)
    K = K._replace(weight=np.zeros_like(K.weight), noise=np.zeros_like(K.noise))
    approximate = empty(K, 0)
    approximate.rows[:], approximate.inverse[:] = 0, 1
    x, taken = solve(K, approximate, 9, np.resize([1.0, -1.0], K.noise.size))
    assert taken == 0
    assert (x == 0).all()


def test_lobes_as_a_whole_save_steps():
    """Without them, the light that all nodes of a lobe have in common takes most steps."""
    left = np.zeros(2)
    for seed in range(10):
        K, sums, share, square = problem(1, 1, seed=seed)
        exact = dense(K)
        # as residuals are that have this covariance
        r = np.linalg.cholesky(exact) @ np.random.default_rng(seed).standard_normal(len(exact))
        expected = np.linalg.solve(exact, r)
        for i, lobes in enumerate((2, 0)):
            approximate = empty(K, lobes)
            precondition(K, sums[:lobes], share[:lobes], square, approximate)
            x = solve(K, approximate, 3, r)[0]
            left[i] += (x - expected) @ exact @ (x - expected) / (expected @ r)
    assert left[0] < left[1] / 2
