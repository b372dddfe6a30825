"""What constant monitors say: S and rho of each pixel, the camera's noise, and its crosstalk."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.noise import LEAST_READ, Noise, noise_line

# A camera of which nothing is known: a full well of 20,000 electrons, and read noise of 0.15 % of full scale.
TYPICAL_SHOT = 1 / 20_000
TYPICAL_READ = 0.0015**2

_SAMPLE = 4096
_MOST_CROSSTALK = 0.9


@dataclass(frozen=True)
class Photometry:
    """What a pixel adds to the monitor's light, and the share of it that arrives (S and rho of eq. 5).

    Attributes
    ----------
    S : (n, 3) float32
        Light that is not the monitor's, in camera units (full scale is 1).
    rho : (n, 3) float32
        Camera value a unit of the monitor's light, 0 or more.
    black, white : (n, 3) float32
        Variances of S and of S + rho, the camera's values before a black and a white monitor.
    """

    S: NDArray[np.float32]
    rho: NDArray[np.float32]
    black: NDArray[np.float32]
    white: NDArray[np.float32]


def fit_photometry(
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
    usable: NDArray[np.bool_],
    noise: Noise,
    frames: NDArray[np.number],
) -> Photometry:
    """Fit S and rho to the frames of constant monitors.

    Parameters
    ----------
    values : (n, k, 3) float32
        Linear camera values of n pixels before k constant monitors.
    levels : (k, 3) float32
        Light of each monitor by channel, 0 to 1.
    usable : (n, k, 3) bool
        False where a value says nothing, as where the camera clipped it.
    noise : Noise
        Noise of one frame.
    frames : (k,) or (n, k, 3) number
        Frames averaged into each value, above 0; longer exposures count as more.

    Returns
    -------
    Photometry
        A pixel and channel with fewer than two different usable levels is fitted to all of its levels.

    Raises
    ------
    ValueError
        If the shapes do not fit, or a channel has no two different levels.

    Notes
    -----
    Least squares of eq. 6, ``C = S + rho b``, weighted by the inverse variance of the values, with rho >= 0.

    Examples
    --------
    >>> values = np.full((1, 2, 3), [[0.1], [0.7]], np.float32)
    >>> levels = np.full((2, 3), [[0], [1]], np.float32)
    >>> found = fit_photometry(values, levels, values > 0, Noise(1e-6, 0), np.ones(2))
    >>> print(found.S.round(3), found.rho.round(3))
    [[0.1 0.1 0.1]] [[0.6 0.6 0.6]]
    """
    _check(values, levels, usable)
    if (np.ptp(levels, axis=0) == 0).any():
        raise ValueError("every channel needs at least two different constant levels")
    weight = (frames[:, None] if frames.ndim == 1 else frames) / noise.variance(values).astype(np.float64)
    weight = np.where(_decisive(levels, usable), weight, 0)
    total = weight.sum(axis=1)
    mean_level = (weight * levels).sum(axis=1) / total
    mean_value = (weight * values).sum(axis=1) / total
    offset = levels - mean_level[:, None]
    spread = (weight * offset**2).sum(axis=1)
    rho = np.maximum((weight * offset * values).sum(axis=1) / spread, 0)
    S = mean_value - rho * mean_level
    black, white = (1 / total + (level - mean_level) ** 2 / spread for level in (0, 1))
    return Photometry(*(array.astype(np.float32) for array in (S, rho, black, white)))


def estimate_noise(
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
    usable: NDArray[np.bool_],
    quantum: float,
    frames: NDArray[np.integer] | None = None,
) -> Noise:
    """Estimate the noise of a frame from how far constant monitors lie from the line of eq. 6.

    Parameters
    ----------
    values : (n, k, 3) float32
        Linear camera values of n pixels before k constant monitors; a sample of the pixels is used.
    levels : (k, 3) float32
        Light of each monitor by channel, 0 to 1.
    usable : (n, k, 3) bool
        False where a value says nothing, as where the camera clipped it.
    quantum : float
        Step between two stored values, in units of full scale.
    frames : (k,) integer, optional
        Frames averaged into each value; one each if left out.

    Returns
    -------
    Noise
        With fewer than four frames, or none usable, that of a typical sensor (a full well of 20,000
        electrons, read noise of 0.15 % of full scale) plus the quantisation's.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    The residuals of an unweighted line are ``R e``, R the projector that takes lines out. If the error e_j of
    frame j has the variance ``(read + shot v_j) / frames_j``, a residual has
    ``read a + shot b``, ``a = sum_j R_ij^2 / frames_j``, ``b = sum_j R_ij^2 v_j / frames_j``. The mean of
    ``r^2 / a`` over residuals of similar b / a, without the largest tenth and in units of the same of a chi-square
    variable, is one robust sample of the line ``read + shot (b / a)``, which is fitted with both terms >= 0. (A
    median would fail where rounding leaves only a few different values.)
    """
    _check(values, levels, usable)
    floor = max(quantum**2 / 12, LEAST_READ)
    typical = Noise(TYPICAL_READ + floor, TYPICAL_SHOT)
    channels = range(3) if len(levels) >= 4 else ()
    step = max(1, -(-values.shape[0] // _SAMPLE))
    share = 1 / (np.ones(len(levels)) if frames is None else frames)
    pairs = [_residuals(values[::step, :, c], levels[:, c], usable[::step, :, c], share) for c in channels]
    level = np.concatenate([np.zeros(0), *(pair[0] for pair in pairs)])
    square = np.concatenate([np.zeros(0), *(pair[1] for pair in pairs)])
    return noise_line(level, square, floor) or typical


def estimate_crosstalk(
    values: NDArray[np.float32], levels: NDArray[np.float32], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Estimate how much of each of the monitor's colours the camera's other channels see.

    Parameters
    ----------
    values : (n, k, 3) float32
        Linear camera values of n pixels before k constant monitors.
    levels : (k, 3) float32
        Light of each monitor by channel, 0 to 1.
    usable : (n, k, 3) bool
        False where a value says nothing.

    Returns
    -------
    (3, 3) float64
        X of ``C = S + X (rho T L)``: row the camera's channel, column the monitor's, 1 on the diagonal. The identity if
        the monitors do not show the colours apart, or the camera does not separate them.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    Each pixel's values are fitted by ``s + G b``; X_cd is the slope of G_cd over G_dd through zero.
    """
    _check(values, levels, usable)
    design = np.concatenate([np.ones((len(levels), 1)), levels], axis=1)
    whole = usable.all(axis=(1, 2))
    if np.linalg.matrix_rank(design) < 4 or not whole.any():
        return np.eye(3)
    gain = np.einsum("dk,nkc->ncd", np.linalg.pinv(design)[1:], values[whole].astype(np.float64))
    own = gain[:, [0, 1, 2], [0, 1, 2]]
    energy = (own**2).sum(axis=0)
    if not energy.all():
        return np.eye(3)
    mixed: NDArray[np.float64] = np.einsum("ncd,nd->cd", gain, own) / energy
    # a camera without colours sees all of them alike
    return mixed if np.abs(mixed - np.eye(3)).sum(axis=1).max() < _MOST_CROSSTALK else np.eye(3)


def _check(values: NDArray[np.float32], levels: NDArray[np.float32], usable: NDArray[np.bool_]) -> None:
    if values.ndim != 3 or values.shape != usable.shape or values.shape[1:] != levels.shape:
        raise ValueError(f"shapes do not fit: {values.shape}, {levels.shape}, {usable.shape}")
    if levels.shape[1:] != (3,):
        raise ValueError(f"levels must be (k, 3), not {levels.shape}")


def _decisive(levels: NDArray[np.float32], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`usable`, but everything where the usable levels are not two different ones."""
    highest = np.where(usable, levels, -np.inf).max(axis=1, keepdims=True)
    lowest = np.where(usable, levels, np.inf).min(axis=1, keepdims=True)
    decisive: NDArray[np.bool_] = usable | ~(highest > lowest)
    return decisive


def _residuals(
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
    usable: NDArray[np.bool_],
    share: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """b / a and r^2 / a of :func:`estimate_noise` for one channel of (n, k) values."""
    mask = usable.astype(np.float64)
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1)
    offset = mask * (levels - (mask * levels).sum(axis=1, keepdims=True) / count)
    spread = (offset**2).sum(axis=1, keepdims=True)
    usual = (mask.sum(axis=1) >= 4) & (spread[:, 0] > 0)
    mask, offset, spread, count = mask[usual], offset[usual], spread[usual], count[usual]
    data = values[usual].astype(np.float64)
    line = mask[:, :, None] * mask[:, None] / count[:, None]
    line += offset[:, :, None] * offset[:, None] / spread[:, None]
    fitted = np.einsum("nij,nj->ni", line, data)
    squared = (mask[:, :, None] * np.eye(len(levels)) - line) ** 2
    a = squared @ share
    b = np.einsum("nij,nj->ni", squared, fitted * share)
    kept = (mask > 0) & (a > 1e-6)
    return b[kept] / a[kept], (data - fitted)[kept] ** 2 / a[kept]
