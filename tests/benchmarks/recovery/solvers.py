"""Libraries' own solvers for T, pixel by pixel and channel by channel, to set beside the recoveries.

Orthogonal matching pursuit ends at the noise's own residual, or at a fifth of the measurements (at a coarse level, as
many); the non-negative lasso's penalty is the noise's ``sigma sqrt(2 ln s / m)``; orthogonal matching pursuit and
non-negative least squares get a row that asks T to sum to one, as heavy as all measurements together. Negative weights
are cut off, and each T is normalised.
"""

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.dgsr.groups import Rows
from workflows.recovery.normalise import normalise
from workflows.recovery.sensing import Sensing
from workflows.recovery.transport import Transport

Recover = Callable[[PatternLight, Photometry, Sensing, NoiseModel], Transport]
Solve = Callable[[NDArray[np.float64], NDArray[np.float64], float, int], NDArray[np.float64]]


def rival(solve: Solve, levels: str) -> Recover:
    """A method that solves for T pixel by pixel and channel by channel."""

    def recover(
        light: PatternLight, photometry: Photometry, sensing: Sensing, noise: NoiseModel
    ) -> Transport:
        measured = normalise(light, photometry, noise, 3.0)
        index = np.arange(3 * len(light.values)).reshape(-1, 3)
        used = sensing.levels if levels == "hierarchical" else sensing.levels[-1:]
        rows = Rows.whole(index.size, used[0])
        for i, level in enumerate(used):
            if i > 0:
                rows = rows.split(used[i - 1], level, 0.02, reach=0)
            limit = level.patterns.size // (5 if level is used[-1] else 1)
            matrix = 2 * level.light[0].T.astype(np.float64) - 1
            for (p, c), row in np.ndenumerate(index):
                own = slice(rows.begin[row], rows.begin[row + 1])
                sigma = float(np.sqrt(measured.variance[p, c, level.patterns].mean()))
                if rows.cell[own].size and np.isfinite(sigma):
                    target = measured.value[p, c, level.patterns].astype(np.float64)
                    rows.weight[own] = np.maximum(solve(matrix[:, rows.cell[own]], target, sigma, limit), 0)
        return rows.transport(used[-1], index)

    return recover


def _with_sum(matrix: NDArray[np.float64], target: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    heavy = np.sqrt(len(target))
    return np.vstack([matrix, np.full(matrix.shape[1], heavy)]), np.append(target, heavy)


def pursuit(
    matrix: NDArray[np.float64], target: NDArray[np.float64], sigma: float, limit: int
) -> NDArray[np.float64]:
    from sklearn.linear_model import orthogonal_mp  # imported where used, as an extra

    m = len(target)
    matrix, target = _with_sum(matrix, target)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # it warns when it stops because of linear dependence
        path = orthogonal_mp(matrix, target, n_nonzero_coefs=min(limit, matrix.shape[1]), return_path=True)
    path = path.reshape(matrix.shape[1], -1)
    left = ((target[:, None] - matrix @ path) ** 2).sum(axis=0)
    quiet = np.flatnonzero(left <= m * sigma**2)
    answer: NDArray[np.float64] = path[:, quiet[0] if quiet.size else -1]
    return answer


def lasso(
    matrix: NDArray[np.float64], target: NDArray[np.float64], sigma: float, limit: int
) -> NDArray[np.float64]:
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import Lasso

    m, s = matrix.shape
    model = Lasso(
        sigma * np.sqrt(2 * np.log(max(s, 2)) / m), fit_intercept=False, positive=True, max_iter=2000
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        answer: NDArray[np.float64] = model.fit(np.asfortranarray(matrix), target).coef_
    return answer


def least_squares(
    matrix: NDArray[np.float64], target: NDArray[np.float64], sigma: float, limit: int
) -> NDArray[np.float64]:
    answer: NDArray[np.float64] = nnls(*_with_sum(matrix, target), maxiter=20 * matrix.shape[1])[0]
    return answer
