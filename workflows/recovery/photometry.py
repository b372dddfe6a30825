"""S and rho of each pixel from constant monitors, the camera's noise, and measurements in units of T."""

from dataclasses import dataclass
from typing import NamedTuple

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
# A chi-square variable's mean without its largest tenth: P(chi-square of 3 <= its 90th percentile) / 0.9.
_TRIM, _TRIMMED_CHI_SQUARE = 0.9, 0.623011
_MOST_CROSSTALK = 0.9
# Standard deviations that S and S + rho may move when they are fitted once more.
_TRUST = 2.0


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


def noise_line(
    level: NDArray[np.floating], square: NDArray[np.floating], floor: float, *, trim: float = _TRIM
) -> Noise | None:
    """The noise of which there are samples.

    Parameters
    ----------
    level : (k,) float
        Linear camera values.
    square : (k,) float
        Squares of single errors at these, each its variance times a chi-square variable of one degree.
    floor : float
        The least variance.
    trim : float
        Share of the samples of a level that is used, the least ones: 0.9, or 1.

    Returns
    -------
    Noise or None
        None of fewer than 120 samples.
    """
    if level.size < 10 * _BINS:
        return None
    order = np.argsort(level, kind="stable")
    bins = np.array_split(order, _BINS)
    middle = np.array([level[b].mean() for b in bins])
    lowest = [np.sort(square[b])[: int(trim * len(b))] for b in bins]
    variance = np.array([least.mean() for least in lowest]) / (_TRIMMED_CHI_SQUARE if trim < 1 else 1)
    variance = np.maximum(variance, floor)
    # the error of a sample variance is in proportion to it
    design = np.stack([np.ones(_BINS), np.maximum(middle, 0)], axis=1) / variance[:, None]
    (read, shot), _ = nnls(design, np.ones(_BINS))
    return Noise(max(float(read), floor), float(shot))


class Measured(NamedTuple):
    """Measurements in the +-1 form of eq. 8, where T is all there is between patterns and camera.

    Attributes
    ----------
    value : (n, 3, m + 2) float32
        ``2 (C - S) / rho - 1``: T times patterns of -1 (black) and 1 (white). The last two are a black and a white
        monitor, -1 and 1. 0 where nothing was measured.
    variance : (n, 3, m + 2) float32
        Of `value`; infinite where nothing was measured.
    """

    value: NDArray[np.float32]
    variance: NDArray[np.float32]


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
        the monitors do not tell the colours apart, or the camera does not.

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


def normalise(
    measurements: NDArray[np.float32],
    photometry: Photometry,
    noise: Noise,
    least_contrast: float,
    usable: NDArray[np.bool_] | None = None,
    frames: NDArray[np.number] | None = None,
) -> Measured:
    """Bring measurements to the +-1 form of eq. 8.

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values C. One that is not finite was not measured.
    photometry : Photometry
        S and rho of the n pixels.
    noise : Noise
        Noise of a frame.
    least_contrast : float
        A channel whose rho is below this many standard deviations of a mid-grey value says nothing of T.
    usable : (n, m, 3) bool, optional
        False where a value says nothing, as where the camera clipped it; all say something if left out.
    frames : (m,) or (n, m, 3) number, optional
        Frames averaged into each value, above 0; one each if left out.

    Returns
    -------
    Measured

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
    there = alive & np.isfinite(light)
    if usable is not None:
        there &= usable.transpose(0, 2, 1)
    light = np.where(there, light, 0)
    if frames is not None and frames.ndim == 3:
        frames = frames.transpose(0, 2, 1)
    variance = noise.variance(light) / (1 if frames is None else frames)
    ends = np.stack([photometry.black, photometry.white], axis=2)
    value = np.where(there, 2 * (light - S) / scale - 1, 0)
    known = np.where(alive, np.array([-1, 1], np.float32), 0)
    spread = np.where(there, 4 * variance / scale**2, np.inf)
    return Measured(
        np.concatenate([value, known], axis=2).astype(np.float32),
        np.concatenate([spread, np.where(alive, 4 * ends / scale**2, np.inf)], axis=2).astype(np.float32),
    )


def refit(
    photometry: Photometry,
    measured: Measured,
    response: NDArray[np.float32],
    kappa: NDArray[np.floating],
) -> Photometry:
    """Fit S and rho once more, now that T says what each pattern was: all frames know of them, not the constant ones.

    Parameters
    ----------
    photometry : Photometry
        With which the measurements were brought to their form.
    measured : Measured
    response : (n, 3, m + 2) float32
        What T makes of the patterns, in the same form.
    kappa : (n, 3) float
        Variance of a pattern of full contrast that T does not account for.

    Returns
    -------
    Photometry
        The old one where T says nothing, and everywhere within two standard deviations of it: of a T that is wrong,
        slopes come out too low.

    Notes
    -----
    With ``value = a + g response``, ``S + rho (value + 1) / 2`` is ``S' + rho' (response + 1) / 2`` of
    ``rho' = g rho`` and ``S' = S + rho (1 + a - g) / 2``.
    """
    m = response.shape[2] - 2
    unknown = np.zeros(response.shape)
    unknown[:, :, :m] = kappa[..., None] * np.maximum(1 - response[:, :, :m] ** 2, 0)
    weight = 1 / (measured.variance + unknown)
    total = weight.sum(axis=2, keepdims=True)
    known = total[..., 0] > 0
    total[~known] = 1
    mean = (weight * response).sum(axis=2, keepdims=True) / total
    mean_value = (weight * measured.value).sum(axis=2, keepdims=True) / total
    offset = response - mean
    spread = (weight * offset**2).sum(axis=2)
    known &= spread > 0
    g = (weight * offset * (measured.value - mean_value)).sum(axis=2) / np.where(known, spread, 1)
    g = np.where(known, np.maximum(g, 0), 1)
    a = np.where(known, (mean_value - g[..., None] * mean)[..., 0], 0)
    S, white = photometry.S, photometry.S + photometry.rho
    black_range, white_range = _TRUST * np.sqrt(photometry.black), _TRUST * np.sqrt(photometry.white)
    new_S = np.clip(S + photometry.rho * (1 + a - g) / 2, S - black_range, S + black_range)
    new_white = np.clip(S + photometry.rho * (1 + a + g) / 2, white - white_range, white + white_range)
    S, white = np.where(known, new_S, S), np.where(known, np.maximum(new_white, new_S), white)
    return Photometry(
        S.astype(np.float32),
        np.where(known, white - S, photometry.rho).astype(np.float32),
        photometry.black,
        photometry.white,
    )


def expected_error(
    photometry: Photometry, measured: Measured, misfit: NDArray[np.floating]
) -> NDArray[np.float32]:
    """The error to expect of composites, from how far T was from explaining the measurements.

    Parameters
    ----------
    photometry : Photometry
    measured : Measured
    misfit : (n, 3) float
        Squared residuals of the measurements less their variances, in the mean.

    Returns
    -------
    (n,) float32
        Root of the mean square over the channels, in camera units; infinite where no channel was measured.

    Notes
    -----
    A pattern is a backdrop like any other: what T misses of the patterns it misses of composites, times rho / 2, for
    patterns are +-1. Where the residuals are no larger than noise, the error is at least that of a mean of them.
    """
    there = np.isfinite(measured.variance)
    used = there.sum(axis=2)
    noise = np.where(there, measured.variance, 0).sum(axis=2) / np.maximum(used, 1) ** 2
    square = (photometry.rho**2 / 4 * np.maximum(misfit, noise)).mean(axis=1)
    error: NDArray[np.float32] = np.where(used.any(axis=1), np.sqrt(square), np.inf).astype(np.float32)
    return error


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
