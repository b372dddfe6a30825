"""The default recovery: a few oriented Gaussian lobes, and about them the posterior mean of T."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.lobes.options import FINE, LobesOptions
from workflows.recovery.lobes.pixels import Explained, Pixels, recover_pixels
from workflows.recovery.noise import Noise
from workflows.recovery.normalise import Measurements, expected_error, normalise, refit_photometry
from workflows.recovery.photometry import Photometry
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import Transport

# Pixels at a time, so that the working arrays stay small whatever a caller passes.
_BLOCK = 256


class Recovery(NamedTuple):
    """What was recovered of n pixels.

    Attributes
    ----------
    transport : Transport
    photometry : Photometry
        S and rho, fitted once more with T.
    error : (n,) float32
        Root of the mean squared error to expect of a composite's channels, in camera units; infinite where nothing
        could be recovered.
    """

    transport: Transport
    photometry: Photometry
    error: NDArray[np.float32]


def recover(
    measurements: NDArray[np.float32],
    photometry: Photometry,
    patterns: Patterns,
    noise: Noise,
    usable: NDArray[np.bool_] | None = None,
    frames: NDArray[np.number] | None = None,
    options: LobesOptions = FINE,
) -> Recovery:
    """Recover T as a few oriented Gaussian lobes, and then as what the measurements say about these.

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values of n pixels under the m patterns. One that is not finite is left out.
    photometry : Photometry
        S and rho of the pixels, from constant monitors.
    patterns : Patterns
        The patterns' light on a pyramid over the monitor.
    noise : Noise
        Noise of a frame.
    usable : (n, m, 3) bool, optional
        False where a value says nothing, as where the camera clipped it.
    frames : (m,) or (n, m, 3) number, optional
        Frames averaged into each value, above 0; one each if left out.
    options : LobesOptions

    Returns
    -------
    Recovery

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    The model is eq. 5 with T a sum of the pyramid's bumps. Lobes are added where they explain most
    (:func:`~workflows.recovery.lobes.search.search`), all of them fitted
    (:func:`~workflows.recovery.lobes.mixture.refine`), and kept if they pay for themselves. What they leave
    out, a sharp edge or a bend, is what :func:`~workflows.recovery.lobes.posterior.update` finds.

    Channels that saw the same patterns are weighed into one measurement, the others stacked. Where they disagree,
    each gets its own T, fitted from the common lobes.
    """
    n, m = len(measurements), patterns.count
    if measurements.shape != (n, m, 3):
        raise ValueError(f"measurements must be (n, {m}, 3), not {measurements.shape}")
    measured = normalise(measurements, photometry, noise, options.least_contrast, usable, frames)
    response, kappa, misfit = np.zeros_like(measured.value), np.zeros((n, 3)), np.zeros((n, 3))
    parts = []
    for first in range(0, max(n, 1), _BLOCK):
        block = slice(first, first + _BLOCK)
        of_block = Measurements(measured.value[block], measured.variance[block])
        parts.append(
            _recover_block(patterns, of_block, options, response[block], kappa[block], misfit[block])
        )
    better = refit_photometry(photometry, measured, response, kappa)
    return Recovery(Transport.concatenate(parts), better, expected_error(better, measured, misfit))


def _recover_block(
    patterns: Patterns,
    measured: Measurements,
    options: LobesOptions,
    response: NDArray[np.float32],
    kappa: NDArray[np.float64],
    misfit: NDArray[np.float64],
) -> Transport:
    """Recover some pixels; `response`, `kappa` and `misfit` are written."""
    columns, rows = patterns.pyramid.grids[0]
    alive = np.isfinite(measured.variance).any(axis=(1, 2))
    own = Measurements(measured.value[alive], measured.variance[alive])
    if patterns.channels == 1:
        joint = _mean(own)
        apart = _disagree(own, joint.value, options.disagreement)
    else:
        n, channels, m = own.value.shape
        joint = Measurements(own.value.reshape(n, channels * m), own.variance.reshape(n, channels * m))
        apart = np.zeros(n, bool)
    counts = np.zeros((len(apart), 3), np.int64)
    seen, left_out, missed = np.zeros_like(own.value), np.zeros(counts.shape), np.zeros(counts.shape)
    pixels = Pixels(patterns.pyramid.arrays, patterns.code, joint, own)
    node, weight = recover_pixels(pixels, apart, options, Explained(seen, left_out, missed, counts))
    response[alive], kappa[alive], misfit[alive] = seen, left_out, missed
    count, shared = np.zeros((alive.size, 3), np.int64), np.zeros(alive.size, bool)
    count[alive], shared[alive] = counts, ~apart
    row = np.repeat(np.arange(count.size), count.ravel())
    order = np.lexsort((node, row))
    row, node, weight = row[order], node[order], weight[order]
    # a node under two lobes is there twice
    new = np.append(True, (np.diff(row) > 0) | (np.diff(node) > 0))[: row.size]
    begin = np.flatnonzero(new)
    merged = np.add.reduceat(weight, begin) if begin.size else weight
    count = np.bincount(row[begin], minlength=count.size).reshape(count.shape)
    return Transport.from_rows(columns, rows, count, node[begin], merged, shared, options.least_weight)


def _mean(own: Measurements) -> Measurements:
    """The mean of the channels, (n, m + 2), each weighed by its precision, and its variance."""
    precision = 1 / own.variance
    total = precision.sum(axis=1)
    with np.errstate(divide="ignore"):
        joint_variance = 1 / total
    joint = (own.value * precision).sum(axis=1) * np.where(total > 0, joint_variance, 0)
    return Measurements(joint, joint_variance)


def _disagree(own: Measurements, joint: NDArray[np.float32], disagreement: float) -> NDArray[np.bool_]:
    """(n,) bool: whether the channels differ by more than noise, and S and rho that are not quite known."""
    value, variance = own
    precision, x = 1 / variance, joint[:, np.newaxis]
    total = np.maximum(precision.sum(axis=2, keepdims=True), 1e-12)
    dx = x - (precision * x).sum(axis=2, keepdims=True) / total
    dy = value - (precision * value).sum(axis=2, keepdims=True) / total
    gain = (precision * dx * dy).sum(axis=2) / np.maximum((precision * dx**2).sum(axis=2), 1e-12)
    chi = (precision * (dy - gain[..., np.newaxis] * dx) ** 2).sum(axis=(1, 2))
    used = np.isfinite(variance).sum(axis=2)
    # the mean and, of each channel, an offset and a gain are fitted
    freedom = used.sum(axis=1) - used.max(axis=1) - 2 * (np.count_nonzero(used, axis=1) - 1)
    disagrees: NDArray[np.bool_] = chi > disagreement * np.maximum(freedom, 1)
    return disagrees
