"""S and rho of each pixel, the camera's noise and its crosstalk, estimated from frames of constant monitors."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import LEAST_READ, LEAST_SAMPLES, NoiseModel, fit_noise
from workflows.recovery.camera.pattern_light import PatternLight

TYPICAL_SHOT = 1 / 20_000
"""Shot noise of a full well of 20,000 electrons."""
TYPICAL_READ = 0.0015**2
"""Read noise of 0.15 % of full scale."""

MOSTLY = 0.5
"""Pixels that are clipped under a colour do not count for crosstalk if the others have this share of the light."""

# Most pixels used to estimate the noise.
_SAMPLE = 4096
# If more than this share of dark or bright values is not usable, noise is measured beyond the level below, or above,
# which most of these are.
_MOST_UNUSABLE, _MOST = 0.01, 0.95
# Dark values are below this share of the brightest.
_DARK = 0.25
# What white counts beside colours.
_WHITE = 1e-4
# A camera with a larger row sum of crosstalk is taken as one that does not separate colours.
_MOST_CROSSTALK = 0.9


class Photometry(NamedTuple):
    """S and rho of n pixels (eq. 5): light not from the monitor, and transparency.

    Attributes
    ----------
    S : (n, 3) float32
        Light not from the monitor, in camera units (full scale is 1).
    rho : (n, 3) float32
        Camera value per unit of the monitor's light, 0 or more.
    black_variance, white_variance : (n, 3) float32
        Variances of S and of S + rho, the camera's values under a black and a white monitor.
    """

    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    black_variance: NDArray[np.float32]
    white_variance: NDArray[np.float32]

    def of_pixels(self, pixels: slice | NDArray[np.integer]) -> "Photometry":
        """That of some pixels."""
        return Photometry(*(array[pixels] for array in self))


def fit_photometry(light: PatternLight, levels: NDArray[np.float32], noise: NoiseModel) -> Photometry:
    """Fit S and rho to frames of constant monitors.

    Parameters
    ----------
    light : PatternLight
        Of n pixels under k constant monitors.
    levels : (k, 3) float32
        Light of each monitor by channel, 0 to 1.
    noise : NoiseModel
        Noise of one frame.

    Returns
    -------
    Photometry
        Channels of a pixel with fewer than two different usable levels are fitted to all levels.

    Raises
    ------
    ValueError
        If the shapes do not match, or a channel does not have two different levels.

    Notes
    -----
    Least-squares fit of eq. 6, ``C = S + rho b``, weighted by the inverse variance of the values, with rho >= 0. It is
    the variance at the value that an unweighted fit predicts: by the values themselves, those that are too dark would
    weigh most, whether by noise or since they see a dark part of a film's border.

    Examples
    --------
    >>> values = np.full((1, 2, 3), [[0.1], [0.7]], np.float32)
    >>> levels = np.full((2, 3), [[0], [1]], np.float32)
    >>> found = fit_photometry(PatternLight.of(values), levels, NoiseModel(1e-6, 0))
    >>> print(found.S.round(3), found.rho.round(3))
    [[0.1 0.1 0.1]] [[0.6 0.6 0.6]]
    """
    values, usable, worth = light
    _check_shapes(values, levels, usable)
    if (np.ptp(levels, axis=0) == 0).any():
        raise ValueError("every channel needs at least two different constant levels")
    used = np.where(_select_values(levels, usable), worth, 0).astype(np.float64)
    S, rho, *_ = _fit_line(values, levels, used)
    weight = used / noise.variance(S[:, None] + rho[:, None] * levels)
    return Photometry(*(array.astype(np.float32) for array in _fit_line(values, levels, weight)))


def _fit_line(
    values: NDArray[np.float32], levels: NDArray[np.float32], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """S, rho, and the variances of S and S + rho for values whose variance is 1 / weight, (n, 3) each."""
    total = weight.sum(axis=1)
    mean_level = (weight * levels).sum(axis=1) / total
    mean_value = (weight * values).sum(axis=1) / total
    offset = levels - mean_level[:, None]
    spread = (weight * offset**2).sum(axis=1)
    rho = np.maximum((weight * offset * values).sum(axis=1) / spread, 0)
    black, white = (1 / total + (level - mean_level) ** 2 / spread for level in (0, 1))
    return mean_value - rho * mean_level, rho, black, white


def estimate_noise(
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
    usable: NDArray[np.bool_],
    quantum: float,
) -> NoiseModel:
    """Estimate the noise of a frame from the residuals of constant monitors' values to the line of eq. 6.

    Parameters
    ----------
    values : (n, k, 3) float32
        Linear camera values of n pixels under k constant monitors; a sample of the pixels is used.
    levels : (k, 3) float32
        Light of each monitor by channel, 0 to 1.
    usable : (n, k, 3) bool
        False where a value must be ignored, as where the camera clipped it.
    quantum : float
        Step between two stored values, in units of full scale.

    Returns
    -------
    NoiseModel
        With fewer than four levels or too few usable values, the noise of a typical sensor (a full well of 20,000
        electrons, read noise of 0.15 % of full scale) plus that of quantisation.

    Raises
    ------
    ValueError
        If the shapes do not match.

    Notes
    -----
    The residuals of an unweighted line are ``R e``, R the projector onto the complement of lines. If the error e_j of
    frame j has the variance ``read + shot v_j``, residual i has the variance ``read a + shot b`` with ``a = sum_j
    R_ij^2`` and ``b = sum_j R_ij^2 v_j``. Residuals are binned by b / a. The trimmed
    mean of ``r^2 / a`` in a bin, without the largest tenth, divided by the trimmed mean of a chi-square variable, is a
    robust sample of ``read + shot (b / a)``. This line is fitted with both terms >= 0. (A median would fail where
    rounding leaves only a few different values.)

    Clipping hides noise: of a black near 0 only the values above it are seen, which are close together. So levels at
    which values are not usable are left out.
    """
    _check_shapes(values, levels, usable)
    floor = max(quantum**2 / 12, LEAST_READ)
    typical = NoiseModel(TYPICAL_READ + floor, TYPICAL_SHOT)
    channels = range(3) if len(levels) >= 4 else ()
    step = max(1, -(-values.shape[0] // _SAMPLE))
    found = [_residuals(values[::step, :, c], levels[:, c], usable[::step, :, c]) for c in channels]
    level, square, unused = (
        np.concatenate([np.zeros(0), *arrays]) for arrays in (zip(*found, strict=True) if found else [()] * 3)
    )
    whole = _unclipped(level, unused)
    return fit_noise(level[whole], square[whole], floor) or typical


def estimate_crosstalk(
    values: NDArray[np.float32], levels: NDArray[np.float32], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Estimate the crosstalk between the monitor's colours and the camera's channels.

    Parameters
    ----------
    values : (n, k, 3) float32
        Linear camera values of n pixels under k constant monitors.
    levels : (k, 3) float32
        Light of each monitor by channel, 0 to 1.
    usable : (n, k, 3) bool
        False where a value must be ignored.

    Returns
    -------
    (3, 3) float64
        X of ``C = S + X (rho T L)``: rows are the camera's channels, columns the monitor's, and the diagonal is 1. The
        identity if the monitors do not show separate colours, or the camera does not separate them.

    Raises
    ------
    ValueError
        If the shapes do not match.

    Notes
    -----
    ``s + G b`` is fitted to each pixel's values; X_cd is the slope of G_cd over G_dd through zero. A camera that
    separates colours more than its filters do makes negative light, and clips it. Black, white and the channel's own
    colour then still tell what the other two colours give together, and the solution of least norm shares it. White
    counts for little else: where the light flickers it is no sum of the colours, while G_cd and G_dd are of one frame.
    """
    _check_shapes(values, levels, usable)
    design = np.concatenate([np.ones((len(levels), 1)), levels], axis=1)
    if np.linalg.matrix_rank(design) < 4:
        return np.eye(3)
    worth = np.where((levels > 0).all(axis=1), _WHITE, 1.0)
    gain = np.zeros((len(values), 3, 3))
    whole, own_known = np.zeros((len(values), 3), bool), np.zeros((len(values), 3), bool)
    for c in range(3):
        alone = (levels[:, c] > 0) & (np.delete(levels, c, axis=1) == 0).all(axis=1)
        needed = alone, (levels == 0).all(axis=1), (levels > 0).all(axis=1)
        own_known[:, c] = np.all([usable[:, frames, c].any(axis=1) for frames in needed], axis=0)
        seen = np.where(usable[:, :, c], worth, 0.0)
        fitted, covariance = solve_least_squares(design, seen, np.where(usable[:, :, c], values[:, :, c], 0))
        gain[:, c] = fitted[:, 1:]
        whole[:, c] = np.linalg.matrix_rank(covariance, hermitian=True) == 4
    known = np.asarray((whole | own_known).all(axis=1))
    own = np.where(known[:, np.newaxis], gain[:, [0, 1, 2], [0, 1, 2]], 0)
    mixed = np.eye(3)
    for c in range(3):
        complete = own * whole[:, c, np.newaxis]
        used = complete if (complete**2).sum() > MOSTLY * (own**2).sum() else own
        energy = (used**2).sum(axis=0)
        if not energy.all():
            return np.eye(3)
        mixed[c] = (gain[:, c] * used).sum(axis=0) / energy
    return mixed if np.abs(mixed - np.eye(3)).sum(axis=1).max() < _MOST_CROSSTALK else np.eye(3)


def solve_least_squares(
    design: NDArray[np.float64], weight: NDArray[np.float64], values: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted least squares of many data by one design.

    Parameters
    ----------
    design : (k, p) float64
    weight, values : (..., k) float
        Values must be finite even where their weight is 0.

    Returns
    -------
    solutions : (..., p) float64
        Of least norm where the weights leave a parameter undetermined.
    covariances : (..., p, p) float64
        For values whose variance is 1 / weight; singular where a parameter is undetermined.
    """
    gram = np.einsum("kp,...k,kq->...pq", design, weight, design, optimize=True)
    inverse = np.linalg.pinv(gram, rcond=1e-9, hermitian=True)
    return (inverse @ ((weight * values) @ design)[..., np.newaxis])[..., 0], inverse


def _check_shapes(
    values: NDArray[np.float32], levels: NDArray[np.float32], usable: NDArray[np.bool_]
) -> None:
    if values.ndim != 3 or values.shape != usable.shape or values.shape[1:] != levels.shape:
        raise ValueError(f"shapes do not match: {values.shape}, {levels.shape}, {usable.shape}")
    if levels.shape[1:] != (3,):
        raise ValueError(f"levels must be (k, 3), not {levels.shape}")


def _select_values(levels: NDArray[np.float32], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which values to fit: the usable ones, or all where these do not have two different levels."""
    highest = np.where(usable, levels, -np.inf).max(axis=1, keepdims=True)
    lowest = np.where(usable, levels, np.inf).min(axis=1, keepdims=True)
    fitted: NDArray[np.bool_] = usable | ~(highest > lowest)
    return fitted


def _residuals(
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """b / a and r^2 / a of :func:`estimate_noise` for one channel, from values of shape (n, k).

    The third array has the values that the fitted lines have where no usable value is.
    """
    mask = usable.astype(np.float64)
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1)
    offset = mask * (levels - (mask * levels).sum(axis=1, keepdims=True) / count)
    spread = (offset**2).sum(axis=1, keepdims=True)
    fitting = (mask.sum(axis=1) >= 4) & (spread[:, 0] > 0)
    mask, offset, spread, count = mask[fitting], offset[fitting], spread[fitting], count[fitting]
    data = values[fitting].astype(np.float64)
    line = mask[:, :, None] * mask[:, None] / count[:, None]
    line += offset[:, :, None] * offset[:, None] / spread[:, None]
    slope = np.einsum("ni,ni->n", offset, data)[:, None] / spread
    fitted = (mask * (data - slope * levels)).sum(axis=1, keepdims=True) / count + slope * levels
    squared = (mask[:, :, None] * np.eye(len(levels)) - line) ** 2
    a = squared.sum(axis=2)
    b = np.einsum("nij,nj->ni", squared, fitted)
    kept = (mask > 0) & (a > 1e-6)
    return b[kept] / a[kept], (data - fitted)[kept] ** 2 / a[kept], fitted[mask == 0]


def _unclipped(level: NDArray[np.float64], unused: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which levels, (k,), clipping leaves alone; all if these are too few.

    Parameters
    ----------
    level, unused : (k,) and (u,) float64
        Levels of the values that are usable, and of those that are not.
    """
    limit = _DARK * level.max(initial=0)
    whole = np.ones(level.size, bool)
    dark, lost_dark = level < limit, unused < limit
    if lost_dark.sum() > _MOST_UNUSABLE * dark.sum():
        whole &= level > np.quantile(unused[lost_dark], _MOST)
    if (~lost_dark).sum() > _MOST_UNUSABLE * (~dark).sum():
        whole &= level < np.quantile(unused[~lost_dark], 1 - _MOST)
    enough = min((whole & dark).sum(), (whole & ~dark).sum()) >= LEAST_SAMPLES
    return whole if enough else np.ones_like(whole)
