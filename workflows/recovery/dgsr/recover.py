"""The paper's recovery: non-negative dynamic group sparsity (NN-DGSR), with and without its Gaussian prior."""

import numpy as np
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.dgsr.gaussian_prior import filter_rows
from workflows.recovery.dgsr.groups import Rows
from workflows.recovery.dgsr.options import DEFAULT, DgsrOptions
from workflows.recovery.dgsr.pursuit import System, grow_rows
from workflows.recovery.normalise import (
    PLAIN,
    Conditions,
    Measurements,
    add_model_error,
    expected_error,
    normalise,
)
from workflows.recovery.sensing import Sensing
from workflows.recovery.transport import Transport

# Pixels per block: limits the working arrays.
_BLOCK = 256
# Measurements with larger values, in standard deviations, or larger standard deviations are not used, so that squares
# do not overflow float32.
_MOST_SIGMAS = 1e6
_MOST_DEVIATION = 1e3


def recover(
    light: PatternLight,
    photometry: Photometry,
    sensing: Sensing,
    noise: NoiseModel,
    options: DgsrOptions = DEFAULT,
    conditions: Conditions = PLAIN,
) -> Transport:
    """Recover T by NN-DGSR (Duan, Cai and Zheng, "Compressive environment matting", 2015, Sect. 4.2 and 5.1).

    Parameters
    ----------
    light : PatternLight
        Of n pixels under the m patterns.
    photometry : Photometry
        S and rho of the pixels.
    sensing : Sensing
        The program's levels, coarse to fine.
    noise : NoiseModel
        Noise of one frame.
    options : DgsrOptions
    conditions : Conditions
        Without stray light, which must have been subtracted.

    Returns
    -------
    Transport
        T on the finest grid; rows without usable measurements are empty.

    Raises
    ------
    ValueError
        If the shapes do not match.

    Notes
    -----
    Solves eq. 9 in the +-1 form of eq. 8: ``f = 2 (C - S) / rho - 1 = A t``, t >= 0. Each round takes the proxy
    ``t + A'(f - A t) / m``, adds the cells whose squared proxy plus half of their neighbours' is largest, solves
    a non-negative least-squares problem on these and the previous cells, and prunes the result in the same way
    (Huang, Huang and Metaxas, "Learning with dynamic group sparsity", ICCV 2009).

    Among s cells unrelated to the measurements the best one still lowers ``m ln |r|^2`` by about ``2 ln s``. At the
    finest level no more cells are added once they gain less than that each, and cells of groups that gain less are
    dropped.

    With the Gaussian prior, Gaussians are then fitted to T at the finest level and T is solved for under this prior,
    iteratively (:func:`~workflows.recovery.dgsr.gaussian_prior.filter_row`). A row of few cells that explains the
    measurements better than any Gaussians, with a penalty of ``2 ln s`` per cell, is left unchanged.

    All measurements of a channel have equal weights. Their variances are known only from their own noisy values, so
    weights by variance would favour values that came out too dark. Joint channels are weighted by their mean inverse
    variances: averaged into one measurement under grey patterns, stacked under coloured ones.

    Examples
    --------
    A pixel that sees one cell of a grid of 8 x 6 through the glass, under 40 random patterns:

    >>> from workflows.recovery.sensing import Level
    >>> shown = np.random.default_rng(0).integers(0, 2, (1, 48, 40)).astype(np.float32)
    >>> sensing = Sensing((Level(8, 6, np.arange(40), shown),))
    >>> S, rho, variance = (np.full((1, 3), value, np.float32) for value in (0.1, 0.7, 1e-6))
    >>> values = (S + rho * shown[0, 21, :, np.newaxis])[np.newaxis]
    >>> photometry = Photometry(S, rho, variance, variance)
    >>> transport = recover(PatternLight.of(values), photometry, sensing, NoiseModel(1e-6, 0))
    >>> transport.cell.tolist(), transport.weight.tolist()
    ([21, 21, 21], [1.0, 1.0, 1.0])
    """
    constants = options.constants
    needed = 1 + max(int(level.patterns.max()) for level in sensing.levels)
    if light.values.shape[1] < needed:
        raise ValueError(f"light is of {light.values.shape[1]} patterns, the levels have {needed}")
    measured = normalise(light, photometry, noise, constants.least_contrast)
    measured = add_model_error(measured, conditions.model_error)
    value, weight = _weight_measurements(measured.value[..., :-2], measured.variance[..., :-2])
    parts = []
    for first in range(0, max(len(value), 1), _BLOCK):
        block = slice(first, first + _BLOCK)
        parts.append(_recover_block(value[block], weight[block], sensing, options, grey=conditions.grey))
    return Transport.concatenate(parts)


def _recover_block(
    value: NDArray[np.float32],
    weight: NDArray[np.float32],
    sensing: Sensing,
    options: DgsrOptions,
    *,
    grey: bool,
) -> Transport:
    """Recover some pixels from their measurements and weights, (n, 3, m); all channels as the first if grey."""
    levels = sensing.levels if options.levels == "hierarchical" else sensing.levels[-1:]
    joint, constants = grey or options.channels == "joint", options.constants
    alive = weight.max(axis=2, initial=0) > 0
    if grey:
        weight = weight * np.array([1, 0, 0], np.float32)[:, np.newaxis]
    index = np.full(alive.shape, -1)
    if joint:
        pixel = np.flatnonzero(alive.any(axis=1))
        channel = np.zeros_like(pixel)
        index[pixel] = np.arange(pixel.size)[:, np.newaxis]
    else:
        pixel, channel = map(np.ascontiguousarray, np.nonzero(alive))
        index[pixel, channel] = np.arange(pixel.size)
    rows = Rows.whole(pixel.size, levels[0])
    for i, level in enumerate(levels):
        if i > 0:
            rows = rows.split(levels[i - 1], level, constants.least_group, reach=0)
        finest = level is levels[-1]
        light = np.ascontiguousarray(level.light)
        grey_patterns = len(light) == 1
        source = np.zeros_like(channel) if grey_patterns else channel
        target, scale, variance = _scale_rows(
            value[..., level.patterns],
            weight[..., level.patterns],
            pixel,
            None if joint else channel,
            grey=grey_patterns,
        )
        system = System(light, level.columns, level.rows, source, scale, target, variance)
        grow_rows(system, rows, finest, constants)
        if finest and options.prior == "gaussian":
            rows = filter_rows(system, rows, constants)
    return rows.transport(levels[-1], np.where(alive, index, -1))


def composite_error(
    transport: Transport,
    photometry: Photometry,
    measured: Measurements,
    sensing: Sensing,
) -> NDArray[np.float32]:
    """Estimate the error of composites with a T on the finest grid.

    Parameters
    ----------
    transport : Transport
        T of n pixels.
    photometry : Photometry
    measured : Measurements
        As from :func:`~workflows.recovery.normalise.normalise`.
    sensing : Sensing

    Returns
    -------
    (n,) float32
        As from :func:`~workflows.recovery.normalise.expected_error`.
    """
    level, sizes = sensing.levels[-1], transport.count.ravel().astype(np.int64)
    row = np.repeat(np.arange(sizes.size), sizes)
    channel = np.minimum(row % 3, len(level.light) - 1)
    light = level.light[channel, transport.cell] * transport.weight[:, np.newaxis]
    response = np.zeros((sizes.size, level.patterns.size), np.float32)
    begin = (np.cumsum(sizes) - sizes)[sizes > 0]
    if begin.size:
        response[sizes > 0] = 2 * np.add.reduceat(light, begin) - 1
    value, variance = (array[..., level.patterns] for array in measured)
    used = np.isfinite(variance)
    square = (value - response.reshape(value.shape)) ** 2 - np.where(used, variance, 0)
    misfit = np.where(used, square, 0).sum(axis=2) / np.maximum(used.sum(axis=2), 1)
    return expected_error(photometry, measured, misfit)


def _weight_measurements(
    value: NDArray[np.float32], variance: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weight measurements by the inverse mean variance of their channel; value and weight are 0 where unusable.

    Parameters
    ----------
    value, variance : (n, 3, m) float32
        Measurements in +-1 form and their variances, infinite where nothing was measured.

    Returns
    -------
    value, weight : (n, 3, m) float32
    """
    usable = np.isfinite(value) & (variance < _MOST_DEVIATION**2)
    usable &= np.abs(np.where(usable, value, 0)) < _MOST_SIGMAS * np.sqrt(np.where(usable, variance, 1))
    # contiguous, so that the order of the sum does not depend on the batch
    total = np.ascontiguousarray(np.where(usable, variance, 0)).sum(axis=2, keepdims=True)
    count = usable.sum(axis=2, keepdims=True)
    weight = np.where(usable, count / np.where(total > 0, total, 1), 0)
    return np.where(usable, value, 0).astype(np.float32), weight.astype(np.float32)


def _scale_rows(
    value: NDArray[np.float32],
    weight: NDArray[np.float32],
    pixel: NDArray[np.intp],
    channel: NDArray[np.intp] | None,
    *,
    grey: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Scale the measurements of each row to be solved for to equal variances.

    Parameters
    ----------
    value, weight : (n, 3, m) float32
        Measurements in +-1 form and their inverse variances.
    pixel, channel : (k,) intp
        Pixel and channel of each row; `channel` is None for all channels together.
    grey : bool
        Whether the patterns are grey, so that all channels saw the same.

    Returns
    -------
    target, scale : (k, m or 3 m) float32
        Scaled measurements, and the scales. The squared scales of a row sum to its number of usable measurements.
    variance : (k,) float64
        Variance of a scaled measurement.
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
    # contiguous, so that the order of the sum does not depend on the batch
    value, weight = np.ascontiguousarray(value), np.ascontiguousarray(weight)
    count = np.maximum((weight > 0).sum(axis=1), 1)
    mean = weight.sum(axis=1, dtype=np.float64) / count
    mean = np.where(mean > 0, mean, 1)
    scale = np.sqrt(weight / mean[:, np.newaxis]).astype(np.float32)
    return scale * value, scale, 1 / mean
