"""T from patterns of every scale: a non-negative fit on each grid in turn, started from the one before."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.groups import Rows
from workflows.recovery.photometry import Noise, Photometry, normalise
from workflows.recovery.sensing import Level, Sensing
from workflows.recovery.solvers import descend, signed_rows
from workflows.recovery.transport import Transport

# Pixels at a time, so that the working arrays stay small whatever a caller passes.
_BLOCK = 256


def recover(
    measurements: NDArray[np.float32],
    photometry: Photometry,
    sensing: Sensing,
    noise: Noise,
    *,
    least_group: float = 0.0125,
    sum_strength: float = 0.1,
    sweeps: int = 50,
    tolerance: float = 1e-4,
    disagreement: float = 2.0,
    least_contrast: float = 3.0,
) -> Transport:
    """Recover T level by level, each level using every pattern that is exact on its cells.

    Parameters
    ----------
    measurements : (n, m, 3) float32
        Linear camera values of n pixels under the m patterns.
    photometry : Photometry
        S and rho of the pixels.
    sensing : Sensing
        The program's levels, coarse to fine.
    noise : Noise
        Noise of a measurement.
    least_group : float
        Before a level is refined, a cell is dropped if its weight plus half of its eight neighbours' is no more
        than this. Cells beside the kept ones are taken along.
    sum_strength : float
        Weight of the soft constraint that T sums to one, as a share of all measurements' together.
    sweeps : int
        Most rounds of coordinate descent on a level.
    tolerance : float
        The rounds end when none changes an entry of T by more than this.
    disagreement : float
        One T serves all channels until their chi-square a degree of freedom exceeds this; from that level on
        each has its own.
    least_contrast : float
        A channel whose rho is below this many standard deviations of a mid-grey value gets an empty row.

    Returns
    -------
    Transport
        On the finest grid.

    Raises
    ------
    ValueError
        If the shapes do not fit.

    Notes
    -----
    Minimises ``sum_k (f_k - sum_i t_i (2 L_ik - 1))^2 / v_k + w (1 - sum_i t_i)^2`` over t >= 0: eq. 8 in its
    +-1 form, ``f = 2 (C - S) / rho - 1`` of variance ``v = 4 noise(C) / rho^2``. If all channels saw the same
    grey patterns, f is the inverse-variance mean of theirs, else their rows are stacked.
    """
    value, precision = normalise(measurements, photometry, noise, least_contrast)
    parts = []
    for first in range(0, max(len(value), 1), _BLOCK):
        block = _Block(value[first : first + _BLOCK], precision[first : first + _BLOCK], sensing.levels[0])
        for i, level in enumerate(sensing.levels):
            if i > 0:
                block.rows = block.rows.split(sensing.levels[i - 1], level, least_group, reach=1)
            block.fit(level, sum_strength, sweeps, tolerance, disagreement)
        parts.append(block.transport(sensing.levels[-1]))
    return Transport.concatenate(parts)


class _Block:
    """The rows of some pixels on their way through the levels: one a pixel at first, one a channel where needed."""

    def __init__(self, value: NDArray[np.float32], precision: NDArray[np.float32], coarsest: Level) -> None:
        self.value = value
        self.precision = precision
        self.alive = precision.max(axis=2, initial=0) > 0
        self.pixel = np.flatnonzero(self.alive.any(axis=1))
        self.channel = np.full(self.pixel.size, -1)  # -1: all channels
        self.rows = Rows.whole(self.pixel.size, coarsest)

    def fit(
        self, level: Level, sum_strength: float, sweeps: int, tolerance: float, disagreement: float
    ) -> None:
        """Solve a level for all rows, parting the channels of the pixels where they disagree."""
        options = (sum_strength, sweeps, tolerance)
        grey = level.light.shape[0] == 1
        value, precision = self.value[..., level.patterns], self.precision[..., level.patterns]
        joint = np.flatnonzero(self.channel < 0)
        pixel = self.pixel[joint]
        if grey:
            own, weight = value[pixel], precision[pixel]
            total = weight.sum(axis=1, keepdims=True)
            mean = (weight * own).sum(axis=1, keepdims=True) / total
            # one axis at a time over contiguous memory: the order of the sum is the same in any batch
            misfit = np.ascontiguousarray(weight * (own - mean) ** 2).sum(axis=2).sum(axis=1)
            freedom = (self.alive[pixel].sum(axis=1) - 1) * level.patterns.size
            self._solve(level, joint, np.zeros(joint.size, np.int64), mean, total, options)
        else:
            misfit = self._solve(
                level, joint, np.zeros(joint.size, np.int64), value[pixel], precision[pixel], options
            )
            freedom = self.alive[pixel].sum(axis=1) * level.patterns.size
        self._part(joint[misfit > disagreement * freedom])
        apart = np.flatnonzero(self.channel >= 0)
        pixel, channel = self.pixel[apart], self.channel[apart]
        source = np.zeros(apart.size, np.int64) if grey else channel
        self._solve(
            level, apart, source, value[pixel, channel][:, None], precision[pixel, channel][:, None], options
        )

    def transport(self, level: Level) -> Transport:
        """All that was recovered; a row of all channels is given to each."""
        index = np.full(self.alive.shape, -1)
        joint = self.channel < 0
        index[self.pixel[joint]] = np.flatnonzero(joint)[:, None]
        index[self.pixel[~joint], self.channel[~joint]] = np.flatnonzero(~joint)
        return self.rows.transport(level, np.where(self.alive, index, -1))

    def _part(self, parted: NDArray[np.intp]) -> None:
        """Replace the given rows by one for each of their pixel's live channels."""
        copies = np.ones(self.pixel.size, np.int64)
        copies[parted] = self.alive[self.pixel[parted]].sum(axis=1)
        channel = self.channel.repeat(copies)
        is_parted = np.zeros(self.pixel.size, np.bool_)
        is_parted[parted] = True
        channel[is_parted.repeat(copies)] = np.nonzero(self.alive[self.pixel[parted]])[1]
        self.rows = self.rows.take(np.arange(self.pixel.size).repeat(copies))
        self.pixel = self.pixel.repeat(copies)
        self.channel = channel

    def _solve(
        self,
        level: Level,
        index: NDArray[np.intp],
        source: NDArray[np.int64],
        value: NDArray[np.float32],
        precision: NDArray[np.float32],
        options: tuple[float, int, float],
    ) -> NDArray[np.float64]:
        """Solve some of the rows in place; see :func:`fit_rows`."""
        rows = self.rows
        chi_square: NDArray[np.float64] = fit_rows(
            np.ascontiguousarray(level.light),
            source,
            np.ascontiguousarray(value),
            np.ascontiguousarray(precision),
            rows.begin[index],
            rows.begin[index + 1],
            rows.cell,
            rows.weight,
            *options,
        )
        return chi_square


@njit(nogil=True, cache=True)
def fit_rows(
    light: NDArray[np.float32],
    source: NDArray[np.int64],
    value: NDArray[np.float32],
    precision: NDArray[np.float32],
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    cell: NDArray[np.int32],
    weight: NDArray[np.float32],
    sum_strength: float,
    sweeps: int,
    tolerance: float,
) -> NDArray[np.float64]:
    """Fit the weights of sparse rows to measurements, from the weights they have.

    Parameters
    ----------
    light : (channels, cells, m) float32
        Light of the level, 0 to 1.
    source : (n,) int64
        First channel of `light` that a row's measurements belong to.
    value, precision : (n, c, m) float32
        Measurements in +-1 form of c channels, and their inverse variances.
    begin, end : (n,) int64
        The entries of each row.
    cell, weight : int32, float32
        The entries; weights are overwritten.
    sum_strength, sweeps, tolerance
        As in :func:`recover`.

    Returns
    -------
    (n,) float64
        Chi-square of each row: the squared residuals by their variances, the sum's included.
    """
    n, channels, m = value.shape
    chi_square = np.empty(n)
    for p in range(n):
        own, x = cell[begin[p] : end[p]], weight[begin[p] : end[p]]
        matrix = np.empty((own.size, channels * m + 1), np.float32)
        target = np.empty(channels * m + 1, np.float32)
        total = np.float32(0)
        for c in range(channels):
            scale = np.sqrt(precision[p, c])
            for k in range(m):
                total += precision[p, c, k]
                target[c * m + k] = scale[k] * value[p, c, k]
            signed_rows(light[source[p] + c], own, scale, c * m, matrix)
        target[-1] = np.sqrt(np.float32(sum_strength) * total)
        matrix[:, -1] = target[-1]
        residual = descend(matrix, target, x, sweeps, tolerance)
        chi_square[p] = 0
        for r in residual:
            chi_square[p] += r * r
    return chi_square
