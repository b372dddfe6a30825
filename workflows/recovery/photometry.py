"""S and rho of each pixel from constant monitors, the camera's noise, and measurements in units of T."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

# A camera of which nothing is known: a full well of 20,000 electrons, and read noise of 0.15 % of full scale.
TYPICAL_SHOT = 1 / 20_000
TYPICAL_READ = 0.0015**2
# No frame is exact: 16 bits alone leave this much.
LEAST_READ = 2e-11

_SAMPLE = 4096
_BINS = 12
_MEDIAN_OF_CHI_SQUARE = 0.454936


@dataclass(frozen=True)
class Noise:
    """Noise of one frame: a linear camera value v has the variance ``read + shot * max(v, 0)``.

    Attributes
    ----------
    read : float
        Variance at black, in units of full scale squared; quantisation is part of it.
    shot : float
        Growth of the variance with the value, in units of full scale.
    """

    read: float
    shot: float

    def variance(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """Variance of linear camera values of any shape."""
        lit: NDArray[np.float32] = np.maximum(values, 0).astype(np.float32)
        return np.float32(self.read) + np.float32(self.shot) * lit


@dataclass(frozen=True)
class Photometry:
    """What a pixel adds to the monitor's light, and the share of it that arrives (S and rho of eq. 5).

    Attributes
    ----------
    S : (n, 3) float32
        Light that is not the monitor's, in camera units (full scale is 1).
    rho : (n, 3) float32
        Camera value a unit of the monitor's light, 0 or more.
    """

    S: NDArray[np.float32]
    rho: NDArray[np.float32]


def fit_photometry(
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
    usable: NDArray[np.bool_],
    noise: Noise,
    frames: NDArray[np.integer],
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
    frames : (k,) integer
        Frames averaged into each value, 1 or more.

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
    """
    _check(values, levels, usable)
    if (np.ptp(levels, axis=0) == 0).any():
        raise ValueError("every channel needs at least two different constant levels")
    weight = frames[:, None] / noise.variance(values).astype(np.float64)
    weight = np.where(_decisive(levels, usable), weight, 0)
    total = weight.sum(axis=1)
    mean_level = (weight * levels).sum(axis=1) / total
    mean_value = (weight * values).sum(axis=1) / total
    offset = levels - mean_level[:, None]
    rho = (weight * offset * values).sum(axis=1) / (weight * offset**2).sum(axis=1)
    rho = np.maximum(rho, 0)
    S = mean_value - rho * mean_level
    return Photometry(S.astype(np.float32), rho.astype(np.float32))


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
        With fewer than four different levels, or none usable, that of a typical sensor (a full well of 20,000
        electrons, read noise of 0.15 % of full scale) plus the quantisation's.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    The residuals of an unweighted line are ``R e``, R the projector that takes lines out. If the error e_j of
    frame j has the variance ``(read + shot v_j) / frames_j``, a residual has
    ``read a + shot b``, ``a = sum_j R_ij^2 / frames_j``, ``b = sum_j R_ij^2 v_j / frames_j``. The median of
    ``r^2 / a`` over residuals of similar b / a, in units of the median of a chi-square variable, is one robust
    sample of the line ``read + shot (b / a)``, which is fitted with both terms >= 0.
    """
    _check(values, levels, usable)
    floor = max(quantum**2 / 12, LEAST_READ)
    typical = Noise(TYPICAL_READ + floor, TYPICAL_SHOT)
    channels = [c for c in range(3) if np.unique(levels[:, c]).size >= 4]
    step = max(1, -(-values.shape[0] // _SAMPLE))
    share = 1 / (np.ones(len(levels)) if frames is None else frames)
    pairs = [_residuals(values[::step, :, c], levels[:, c], usable[::step, :, c], share) for c in channels]
    level = np.concatenate([np.zeros(0), *(pair[0] for pair in pairs)])
    square = np.concatenate([np.zeros(0), *(pair[1] for pair in pairs)])
    if level.size < 10 * _BINS:
        return typical
    order = np.argsort(level, kind="stable")
    bins = np.array_split(order, _BINS)
    middle = np.array([level[b].mean() for b in bins])
    variance = np.array([np.median(square[b]) for b in bins]) / _MEDIAN_OF_CHI_SQUARE
    variance = np.maximum(variance, floor)
    # the error of a sample variance is in proportion to it
    design = np.stack([np.ones(_BINS), np.maximum(middle, 0)], axis=1) / variance[:, None]
    (read, shot), _ = nnls(design, np.ones(_BINS))
    return Noise(max(float(read), floor), float(shot))


def normalise(
    measurements: NDArray[np.float32], photometry: Photometry, noise: Noise, least_contrast: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Bring measurements to the +-1 form of eq. 8, with their precision.

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values C.
    photometry : Photometry
        S and rho of the n pixels.
    noise : Noise
        Noise of a value.
    least_contrast : float
        A channel whose rho is below this many standard deviations of a mid-grey value says nothing of T.

    Returns
    -------
    value : (n, 3, m) float32
        ``2 (C - S) / rho - 1``: T times patterns of -1 (black) and 1 (white); 0 where rho is too small.
    precision : (n, 3, m) float32
        Inverse variance of `value`; 0 where rho is too small.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    n = photometry.rho.shape[0]
    if measurements.ndim != 3 or measurements.shape[0] != n or measurements.shape[2] != 3:
        raise ValueError(f"measurements must be ({n}, m, 3), not {measurements.shape}")
    rho, S = photometry.rho[..., None], photometry.S[..., None]
    alive = (rho > 0) & (rho**2 >= least_contrast**2 * noise.variance(S + rho / 2))
    scale = np.where(alive, rho, 1)
    light = np.ascontiguousarray(measurements.transpose(0, 2, 1), dtype=np.float32)
    value = np.where(alive, 2 * (light - S) / scale - 1, 0)
    precision = np.where(alive, scale**2 / (4 * noise.variance(light)), 0)
    return value.astype(np.float32), precision.astype(np.float32)


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
