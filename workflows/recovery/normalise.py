"""Measurements in the form that T is solved from; S, rho and the expected error once T is known."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry

# Standard deviations that S and S + rho may change by when they are fitted again.
_MOST_CHANGE = 2.0


class Conditions(NamedTuple):
    """What else than T the frames of a capture show.

    Attributes
    ----------
    grey : bool
        Whether the three channels are one, repeated, which must not count three times.
    strays : (s, m + 2) float32 or None
        Light that does not come from the patterns, as in :class:`~workflows.recovery.lobes.footprint.PatternCodes`. Its
        last two values are those under a black and a white monitor. None is constant light alone.
    model_error : float
        Standard deviation of what no T explains, as a share of rho: of light that bounces, and of a camera or a monitor
        that is not quite linear.
    """

    grey: bool = False
    strays: NDArray[np.float32] | None = None
    model_error: float = 0.0


PLAIN = Conditions()
"""Frames that show nothing else."""


class Measurements(NamedTuple):
    """Measurements in the +-1 form of eq. 8, free of S and rho: T times the patterns, plus noise.

    Attributes
    ----------
    value : (n, 3, m + 2) float32
        ``2 (C - S) / rho - 1``, for patterns of -1 (black) and 1 (white). The last two values are those of a black and
        a white monitor, -1 and 1. 0 where nothing was measured.
    variance : (n, 3, m + 2) float32
        Variance of `value`; infinite where nothing was measured.
    """

    value: NDArray[np.float32]
    variance: NDArray[np.float32]


def normalise(
    light: PatternLight, photometry: Photometry, noise: NoiseModel, least_contrast: float
) -> Measurements:
    """Convert camera values to the +-1 form of eq. 8.

    Parameters
    ----------
    light : PatternLight
        Of n pixels; its values are C.
    photometry : Photometry
        S and rho of the n pixels.
    noise : NoiseModel
        Noise of one frame.
    least_contrast : float
        A channel whose rho is below this many standard deviations of a mid-grey value is ignored.

    Returns
    -------
    Measurements

    Raises
    ------
    ValueError
        If the shapes do not match.

    Examples
    --------
    A pixel under a black, a half lit and a white pattern, then the two constant monitors:

    >>> S, rho, variance = (np.full((1, 3), value, np.float32) for value in (0.1, 0.5, 1e-6))
    >>> C = np.full((1, 3, 3), [[0.1], [0.35], [0.6]], np.float32)
    >>> photometry = Photometry(S, rho, variance, variance)
    >>> value, variance = normalise(PatternLight.of(C), photometry, NoiseModel(1e-5, 0), 3.0)
    >>> print(value[0, 0].round(3), variance[0, 0].round(6))
    [-1.  0.  1. -1.  1.] [1.6e-04 1.6e-04 1.6e-04 1.6e-05 1.6e-05]
    """
    n, shape = photometry.rho.shape[0], light.values.shape
    if len(shape) != 3 or shape[0] != n or shape[2] != 3:
        raise ValueError(f"light must be ({n}, m, 3), not {shape}")
    rho, S = photometry.rho[..., None], photometry.S[..., None]
    alive = (rho > 0) & (rho**2 >= least_contrast**2 * noise.variance(S + rho / 2))
    scale = np.where(alive, rho, 1)
    seen = np.ascontiguousarray(light.values.transpose(0, 2, 1), dtype=np.float32)
    valid = alive & np.isfinite(seen)
    valid &= light.usable.transpose(0, 2, 1)
    seen = np.where(valid, seen, 0)
    variance = noise.variance(seen) / light.worth.transpose(0, 2, 1)
    constant_variance = np.stack([photometry.black_variance, photometry.white_variance], axis=2)
    value = np.where(valid, 2 * (seen - S) / scale - 1, 0)
    variance = np.where(valid, 4 * variance / scale**2, np.inf)
    constants = np.where(alive, np.array([-1, 1], np.float32), 0)
    constant_variance = np.where(alive, 4 * constant_variance / scale**2, np.inf)
    return Measurements(
        np.concatenate([value, constants], axis=2).astype(np.float32),
        np.concatenate([variance, constant_variance], axis=2).astype(np.float32),
    )


def add_model_error(measured: Measurements, model_error: float) -> Measurements:
    """Add the error of the model to the variances of patterns, but not to those of the black and white monitor.

    The contrast of patterns is twice that of the unit of `model_error`.
    """
    variance = measured.variance.copy()
    size = measured.value.shape[-1]
    variance[..., : size - 2] += np.float32(4 * model_error**2)
    return Measurements(measured.value, variance)


def refit_photometry(
    photometry: Photometry,
    measured: Measurements,
    response: NDArray[np.float32],
    kappa: NDArray[np.floating],
) -> Photometry:
    """Fit S and rho again, given T: to all frames, not only those of constant monitors.

    Parameters
    ----------
    photometry : Photometry
        S and rho with which the measurements were normalised.
    measured : Measurements
    response : (n, 3, m + 2) float32
        Predictions of the measurements from T.
    kappa : (n, 3) float
        Variance of a pattern of full contrast that T does not account for.

    Returns
    -------
    Photometry
        S and rho within two standard deviations of the given ones, since a wrong T makes slopes too low. Unchanged
        where T is empty.

    Notes
    -----
    A line ``value = a + g response`` is fitted. Then ``S + rho (value + 1) / 2 = S' + rho' (response + 1) / 2`` with
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
    black_range, white_range = (
        _MOST_CHANGE * np.sqrt(photometry.black_variance),
        _MOST_CHANGE * np.sqrt(photometry.white_variance),
    )
    new_S = np.clip(S + photometry.rho * (1 + a - g) / 2, S - black_range, S + black_range)
    new_white = np.clip(S + photometry.rho * (1 + a + g) / 2, white - white_range, white + white_range)
    S, white = np.where(known, new_S, S), np.where(known, np.maximum(new_white, new_S), white)
    return Photometry(
        S.astype(np.float32),
        np.where(known, white - S, photometry.rho).astype(np.float32),
        photometry.black_variance,
        photometry.white_variance,
    )


def expected_error(
    photometry: Photometry, measured: Measurements, misfit: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Estimate the error of composites from the residuals of the measurements.

    Parameters
    ----------
    photometry : Photometry
    measured : Measurements
    misfit : (n, 3) float
        Mean of the squared residuals less the variances of the measurements.

    Returns
    -------
    (n,) float32
        Root mean square error over the channels, in camera units; infinite where no channel was measured.

    Notes
    -----
    A pattern is a backdrop like any other, so composites have the same error as predictions of patterns, times
    rho / 2 because patterns are +-1. Its square is at least the variance of the measurements' mean.
    """
    valid = np.isfinite(measured.variance)
    used = valid.sum(axis=2)
    noise = np.where(valid, measured.variance, 0).sum(axis=2) / np.maximum(used, 1) ** 2
    square = (photometry.rho**2 / 4 * np.maximum(misfit, noise)).mean(axis=1)
    error: NDArray[np.float32] = np.where(used.any(axis=1), np.sqrt(square), np.inf).astype(np.float32)
    return error
