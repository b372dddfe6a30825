"""The default method: fit a few oriented Gaussian lobes to each pixel, then take the posterior mean of T."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.lobes.fitting.averages import KEPT, adjacent, average_fits
from workflows.recovery.lobes.fitting.channels import disputed, share_of_separate
from workflows.recovery.lobes.fitting.fits import Fits, Pixels, make_buffers
from workflows.recovery.lobes.fitting.neighbours import coarse_to_fine
from workflows.recovery.lobes.fitting.pixels import fit_pixels
from workflows.recovery.lobes.options import FINE, LobesOptions
from workflows.recovery.lobes.pixels import Diagnostics, finish_pixels
from workflows.recovery.lobes.strays import find_strong_strays, subtract_strays
from workflows.recovery.normalise import (
    PLAIN,
    Conditions,
    Measurements,
    add_model_error,
    expected_error,
    normalise,
    refit_photometry,
)
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import Transport

# Pixels whose rows of T are normalised at once: limits the working arrays.
_BLOCK = 256
# Least difference of white and black without stray light, of 2 with it, for which S and rho are corrected.
_LEAST_CONTRAST = 0.5


class Recovery(NamedTuple):
    """The result for n pixels.

    Attributes
    ----------
    transport : Transport
    photometry : Photometry
        S and rho, fitted again given T.
    error : (n,) float32
        Expected root mean square error of a composite over the channels, in camera units; infinite where nothing could
        be recovered.
    stray : (n, m, 3) float32 or None
        Light of the measurements that does not come from the patterns, in camera units, beside the constant light that
        is part of S. None if the conditions name none.
    """

    transport: Transport
    photometry: Photometry
    error: NDArray[np.float32]
    stray: NDArray[np.float32] | None


def recover(
    light: PatternLight,
    photometry: Photometry,
    patterns: Patterns,
    noise: NoiseModel,
    options: LobesOptions = FINE,
    conditions: Conditions = PLAIN,
    places: NDArray[np.integer] | None = None,
) -> Recovery:
    """Recover T: a few oriented Gaussian lobes, refined to the posterior mean given the measurements.

    Parameters
    ----------
    light : PatternLight
        Of n pixels under the m patterns.
    photometry : Photometry
        S and rho of the pixels, from constant monitors.
    patterns : Patterns
        The patterns' light on a pyramid over the monitor.
    noise : NoiseModel
        Noise of one frame.
    options : LobesOptions
    conditions : Conditions
    places : (n, 2) int, optional
        Rows and columns of the pixels in their frame. Fits then start from those of neighbours, and are averaged
        with those of the pixels about them. Default: each pixel is recovered alone.

    Returns
    -------
    Recovery

    Raises
    ------
    ValueError
        If the shapes do not match.

    Notes
    -----
    The model is eq. 5, T a sum of the pyramid's bumps. Lobes are added where they improve the fit most
    (:func:`~workflows.recovery.lobes.fitting.search.find_node`), all of them are fitted
    (:func:`~workflows.recovery.lobes.fitting.levenberg_marquardt.refine`), and kept if they lower -2 ln likelihood by
    more than their penalty. The posterior mean (:func:`~workflows.recovery.lobes.posterior.mean.update`) adds what
    lobes cannot represent, such as a sharp edge or a bend.

    Channels that saw the same patterns are averaged into one measurement, weighted by precision; others are stacked.
    Where the channels disagree, each gets its own T, whose fit starts from the common lobes or those of the most
    precise channel.

    Examples
    --------
    A pixel that sees one cell of a grid of 8 x 6 through the glass, under 40 random patterns:

    >>> from workflows.recovery.pyramid import Pyramid
    >>> pyramid = Pyramid.over(8, 6)
    >>> code = np.random.default_rng(0).integers(0, 2, (pyramid.nodes, 40)).astype(np.uint8) * np.uint8(255)
    >>> S, rho, variance = (np.full((1, 3), value, np.float32) for value in (0.1, 0.7, 1e-6))
    >>> values = (S + rho * code[21, :, np.newaxis] / 255).astype(np.float32)[np.newaxis]
    >>> patterns = Patterns(pyramid, 1, code)
    >>> photometry = Photometry(S, rho, variance, variance)
    >>> found = recover(PatternLight.of(values), photometry, patterns, NoiseModel(1e-6, 0))
    >>> backdrop = np.zeros((pyramid.nodes, 3), np.float32)
    >>> backdrop[21] = 1
    >>> print(found.transport.apply(backdrop).round(2))
    [[1. 1. 1.]]
    """
    n, m = len(light.values), patterns.count
    if light.values.shape != (n, m, 3):
        raise ValueError(f"light must be (n, {m}, 3), not {light.values.shape}")
    if len(patterns.code) != patterns.pyramid.nodes:
        raise ValueError(f"patterns have {len(patterns.code)} nodes, their pyramid {patterns.pyramid.nodes}")
    strays = np.ones((1, m + 2), np.float32) if conditions.strays is None else conditions.strays
    if strays.ndim != 2 or strays.shape[1] != m + 2:
        raise ValueError(f"strays must be (s, {m + 2}), not {strays.shape}")
    if conditions.grey:
        light = light._replace(usable=light.usable & (np.arange(3) == 0))
    stray: NDArray[np.float32] | None = None
    if len(strays) > 1:
        stray, photometry = find_strong_strays(light, photometry, strays)
        light = light._replace(values=light.values - stray)
    measured = normalise(light, photometry, noise, options.least_contrast)
    counts = np.zeros((n, 3), np.int64)
    found = Diagnostics(
        np.zeros_like(measured.value),
        np.zeros_like(measured.value),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        counts,
    )
    transport = _recover_measured(patterns, measured, options, conditions.model_error, strays, places, found)
    if stray is not None:
        known = _are_known(measured, found.stray)
        weak = photometry.rho[..., np.newaxis] / 2 * found.stray[:, :, :-2]
        stray += np.where(known[..., np.newaxis], weak, 0).transpose(0, 2, 1)
        photometry, measured = _without_strays(photometry, measured, found.stray, known)
    better = refit_photometry(
        photometry, add_model_error(measured, conditions.model_error), found.response, found.kappa
    )
    if conditions.grey:
        better = Photometry(*(np.repeat(values[:, :1], 3, axis=1) for values in better))
    error = expected_error(better, measured, found.misfit)
    return Recovery(transport, better, error, stray)


def _recover_measured(
    patterns: Patterns,
    measured: Measurements,
    options: LobesOptions,
    model_error: float,
    strays: NDArray[np.float32],
    places: NDArray[np.integer] | None,
    found: Diagnostics,
) -> Transport:
    """Recover T from measurements in +-1 form, and write `found`."""
    columns, rows = patterns.pyramid.grids[0]
    n, channels, m = measured.value.shape
    alive: NDArray[np.bool_] = np.any(np.isfinite(measured.variance), axis=(1, 2))
    # The channels' errors of the model are alike, so their mean has the same.
    own = add_model_error(measured, model_error)
    if patterns.channels == 1:
        joint = _average_channels(measured)
        separate = _channels_disagree(measured, joint.value, options.disagreement)
        joint = add_model_error(joint, model_error)
    else:
        joint = Measurements(own.value.reshape(n, channels * m), own.variance.reshape(n, channels * m))
        separate = np.zeros(n, bool)
    pixels = Pixels(patterns.pyramid.arrays, patterns.code, joint, own, strays)
    fits = Fits.of(n, options.most_lobes, len(strays))
    fit_pixels(pixels, alive, *coarse_to_fine(places, n), separate, options, fits)
    share = separate.astype(np.float64)
    if places is not None:
        averages, near = Fits.of(n, options.most_lobes * KEPT, len(strays)), adjacent(places)
        both = disputed(separate, near) if patterns.channels == 3 else np.zeros(n, bool)
        average_fits(pixels, near, separate, both, fits, averages)
        if both.any():
            share = share_of_separate(pixels, near, separate, both, fits, averages, options)
        fits = averages
    shared, parts = alive & (share == 0), []
    buffers = make_buffers(fits.level.shape[2], joint.value.shape[1], patterns.pyramid.nodes)
    for first in range(0, max(n, 1), _BLOCK):
        last = min(first + _BLOCK, n)
        node, weight = finish_pixels(pixels, first, last, share, fits, options, buffers, found)
        parts.append(
            Transport.from_rows(
                columns,
                rows,
                found.nodes[first:last],
                node,
                weight,
                shared[first:last],
                options.least_weight,
            )
        )
    return Transport.concatenate(parts)


def _average_channels(own: Measurements) -> Measurements:
    """The mean of the channels, (n, m + 2), weighted by precision, and its variance."""
    precision = 1 / own.variance
    total = precision.sum(axis=1)
    with np.errstate(divide="ignore"):
        joint_variance = 1 / total
    joint = (own.value * precision).sum(axis=1) * np.where(total > 0, joint_variance, 0)
    return Measurements(joint, joint_variance)


def _are_known(measured: Measurements, stray: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where enough contrast is left without stray light to take it out, (n, 3) bool."""
    black, white = (measured.value[:, :, at] - stray[:, :, at] for at in (-2, -1))
    known: NDArray[np.bool_] = np.isfinite(measured.variance[:, :, -1]) & (white - black > _LEAST_CONTRAST)
    return known


def _without_strays(
    photometry: Photometry, measured: Measurements, stray: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[Photometry, Measurements]:
    """S and rho without stray light, and the measurements that are normalised with these."""
    black, white = (measured.value[:, :, at] - stray[:, :, at] for at in (-2, -1))
    value, variance = measured.value.copy(), measured.variance.copy()
    subtract_strays(value.reshape(-1), variance.reshape(-1), stray.reshape(-1), value.shape[2])
    S = photometry.S + photometry.rho * (black + 1) / 2
    rho = photometry.rho * (white - black) / 2
    return (
        Photometry(
            np.where(known, S, photometry.S).astype(np.float32),
            np.where(known, rho, photometry.rho).astype(np.float32),
            photometry.black_variance,
            photometry.white_variance,
        ),
        Measurements(
            np.where(known[..., np.newaxis], value, measured.value),
            np.where(known[..., np.newaxis], variance, measured.variance),
        ),
    )


def _channels_disagree(
    own: Measurements, joint: NDArray[np.float32], disagreement: float
) -> NDArray[np.bool_]:
    """Whether the channels differ by more than noise and errors of S and rho, (n,) bool."""
    value, variance = own
    precision, x = 1 / variance, joint[:, np.newaxis]
    total = np.maximum(precision.sum(axis=2, keepdims=True), 1e-12)
    dx = x - (precision * x).sum(axis=2, keepdims=True) / total
    dy = value - (precision * value).sum(axis=2, keepdims=True) / total
    gain = (precision * dx * dy).sum(axis=2) / np.maximum((precision * dx**2).sum(axis=2), 1e-12)
    chi = (precision * (dy - gain[..., np.newaxis] * dx) ** 2).sum(axis=(1, 2))
    used = np.isfinite(variance).sum(axis=2)
    # fitted parameters: the mean of the channels, and an offset and a gain of each
    freedom = used.sum(axis=1) - used.max(axis=1) - 2 * (np.count_nonzero(used, axis=1) - 1)
    disagrees: NDArray[np.bool_] = chi > disagreement * np.maximum(freedom, 1)
    return disagrees
