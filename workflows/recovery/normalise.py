"""Measurements in units of T, and what S, rho and the error to expect are once T is known."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.noise import Noise
from workflows.recovery.photometry import Photometry

# Standard deviations that S and S + rho may move when they are fitted once more.
_TRUST = 2.0


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
