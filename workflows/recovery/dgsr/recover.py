"""The paper's recovery: non-negative dynamic group sparsity (NN-DGSR), with and without its Gaussian prior."""

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.dgsr.gaussian_prior import filter_rows
from workflows.recovery.dgsr.groups import Rows
from workflows.recovery.dgsr.options import DEFAULT, DgsrOptions
from workflows.recovery.dgsr.pursuit import System, grow_rows
from workflows.recovery.noise import Noise
from workflows.recovery.normalise import Measured, expected_error, normalise
from workflows.recovery.photometry import Photometry
from workflows.recovery.sensing import Sensing
from workflows.recovery.transport import Transport

# Pixels at a time, so that the working arrays stay small whatever a caller passes.
_BLOCK = 256
# A measurement so many standard deviations from zero, or with one so much larger than the range, says nothing:
# squares of the others fit float32.
_FARTHEST = 1e6
_WIDEST = 1e3


def recover(
    measurements: NDArray[np.float32],
    photometry: Photometry,
    sensing: Sensing,
    noise: Noise,
    usable: NDArray[np.bool_] | None = None,
    frames: NDArray[np.number] | None = None,
    options: DgsrOptions = DEFAULT,
) -> Transport:
    """Recover T by NN-DGSR (Duan, Cai and Zheng, "Compressive environment matting", 2015, Sect. 4.2 and 5.1).

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values of n pixels under the m patterns. One that is not finite is left out.
    photometry : Photometry
        S and rho of the pixels.
    sensing : Sensing
        The program's levels, coarse to fine.
    noise : Noise
        Noise of a frame.
    usable : (n, m, 3) bool, optional
        False where a measurement says nothing, as where the camera clipped it; all say something if left out.
    frames : (m,) or (n, m, 3) number, optional
        Frames averaged into each measurement; one each if left out.
    options : DgsrOptions

    Returns
    -------
    Transport
        On the finest grid; empty rows where the measurements say nothing.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    Solves eq. 9 in the +-1 form of eq. 8: ``f = 2 (C - S) / rho - 1 = A t``, t >= 0. Each round takes the proxy
    ``t + A'(f - A t) / m``, lights the cells whose squared proxy plus half of their neighbours' is largest, solves
    a non-negative least squares on them and the cells so far, and prunes the result in the same way (Huang, Huang
    and Metaxas, "Learning with dynamic group sparsity", ICCV 2009).

    Of s cells that explain nothing the best one still lowers ``m ln |r|^2`` by about ``2 ln s``. Growth at the
    finest level ends when it gains less than that a cell, and cells of a group worth less are dropped.

    From there on, with the Gaussian prior, iterations at the finest level fit Gaussians to T and solve for T under
    them (:func:`~workflows.recovery.dgsr.gaussian_prior.filter_row`). A T of few cells that explains the measurements
    better than any Gaussians, at the same price of ``2 ln s`` a cell, stays as it is.

    All measurements of a channel weigh the same: the variance of one is known from its own noisy value only, and
    weights by it would favour those that came out dark. Joint channels weigh by their mean inverse variance; seen
    under grey patterns they become one measurement, else their rows are stacked.
    """
    constants = options.constants
    measured = normalise(measurements, photometry, noise, constants.least_contrast, usable, frames)
    value, weight = _weigh(measured.value[..., :-2], measured.variance[..., :-2])
    used = sensing.levels if options.levels == "hierarchical" else sensing.levels[-1:]
    parts = []
    for first in range(0, max(len(value), 1), _BLOCK):
        block = slice(first, first + _BLOCK)
        alive = weight[block].max(axis=2, initial=0) > 0
        index = np.full(alive.shape, -1)
        if options.channels == "joint":
            pixel = np.flatnonzero(alive.any(axis=1))
            channel = np.zeros_like(pixel)
            index[pixel] = np.arange(pixel.size)[:, np.newaxis]
        else:
            pixel, channel = map(np.ascontiguousarray, np.nonzero(alive))
            index[pixel, channel] = np.arange(pixel.size)
        rows = Rows.whole(pixel.size, used[0])
        for i, level in enumerate(used):
            if i > 0:
                rows = rows.split(used[i - 1], level, constants.least_group, reach=0)
            finest = level is used[-1]
            light = np.ascontiguousarray(level.light)
            source = np.zeros_like(channel) if len(light) == 1 else channel
            target, scale, variance = _rows_of(
                value[block][..., level.patterns],
                weight[block][..., level.patterns],
                pixel,
                None if options.channels == "joint" else channel,
                grey=len(light) == 1,
            )
            system = System(light, level.columns, level.rows, source, scale, target, variance)
            grow_rows(system, rows, finest, constants)
            if finest and options.prior == "gaussian":
                rows = filter_rows(system, rows, constants)
        parts.append(rows.transport(used[-1], np.where(alive, index, -1)))
    return Transport.concatenate(parts)


def error_of(
    transport: Transport,
    photometry: Photometry,
    measured: Measured,
    sensing: Sensing,
) -> NDArray[np.float32]:
    """The error to expect of composites with a T of the finest level; see :func:`expected_error`.

    Parameters
    ----------
    transport : Transport
        Of n pixels.
    photometry : Photometry
    measured : Measured
    sensing : Sensing

    Returns
    -------
    (n,) float32
    """
    level, sizes = sensing.levels[-1], transport.count.ravel().astype(np.int64)
    row = np.repeat(np.arange(sizes.size), sizes)
    channel = np.minimum(row % 3, len(level.light) - 1)
    seen = level.light[channel, transport.cell] * transport.weight[:, np.newaxis]
    response = np.zeros((sizes.size, level.patterns.size), np.float32)
    begin = (np.cumsum(sizes) - sizes)[sizes > 0]
    if begin.size:
        response[sizes > 0] = 2 * np.add.reduceat(seen, begin) - 1
    value, variance = (array[..., level.patterns] for array in measured)
    used = np.isfinite(variance)
    square = (value - response.reshape(value.shape)) ** 2 - np.where(used, variance, 0)
    misfit = np.where(used, square, 0).sum(axis=2) / np.maximum(used.sum(axis=2), 1)
    return expected_error(photometry, measured, misfit)


def _weigh(
    value: NDArray[np.float32], variance: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Measurements with the inverse of their channel's mean variance; both 0 for one that says nothing.

    Parameters
    ----------
    value, variance : (n, 3, m) float32
        Measurements in +-1 form and their variances, infinite where nothing was measured.

    Returns
    -------
    value, weight : (n, 3, m) float32
    """
    usable = np.isfinite(value) & (variance < _WIDEST**2)
    usable &= np.abs(np.where(usable, value, 0)) < _FARTHEST * np.sqrt(np.where(usable, variance, 1))
    # one axis at a time over contiguous memory: the order of the sum is the same in any batch
    total = np.ascontiguousarray(np.where(usable, variance, 0)).sum(axis=2, keepdims=True)
    count = usable.sum(axis=2, keepdims=True)
    weight = np.where(usable, count / np.where(total > 0, total, 1), 0)
    return np.where(usable, value, 0).astype(np.float32), weight.astype(np.float32)


def _rows_of(
    value: NDArray[np.float32],
    weight: NDArray[np.float32],
    pixel: NDArray[np.intp],
    channel: NDArray[np.intp] | None,
    *,
    grey: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """The measurements of each row to solve for, scaled to one variance.

    Parameters
    ----------
    value, weight : (n, 3, m) float32
        Measurements in +-1 form and their inverse variances.
    pixel, channel : (k,) intp
        Whose measurements a row has; those of all channels if `channel` is None.
    grey : bool
        Whether the channels saw the same patterns.

    Returns
    -------
    target, scale : (k, m or 3 m) float32
        Scaled measurements, and the scales; a row's squared scales add up to its usable measurements.
    variance : (k,) float64
        Of a scaled measurement.
    """
    if channel is not None:
        value, weight = value[pixel, channel], weight[pixel, channel]
    elif grey:
        total = weight[pixel].sum(axis=1)
        value = (weight * value)[pixel].sum(axis=1) / np.where(total > 0, total, 1)
        weight = total
    else:
        size = 3 * value.shape[2]
        value, weight = value[pixel].reshape(pixel.size, size), weight[pixel].reshape(pixel.size, size)
    # one axis at a time over contiguous memory: the order of the sum is the same in any batch
    value, weight = np.ascontiguousarray(value), np.ascontiguousarray(weight)
    count = np.maximum((weight > 0).sum(axis=1), 1)
    mean = weight.sum(axis=1, dtype=np.float64) / count
    mean = np.where(mean > 0, mean, 1)
    scale = np.sqrt(weight / mean[:, np.newaxis]).astype(np.float32)
    return scale * value, scale, 1 / mean
