"""Columns and rows distinguished by their frequencies: Zhu and Yang 2004, and Qian et al. 2015."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from tests.benchmarks.field.methods.method import (
    Film,
    Floats,
    Matte,
    Pictures,
    Program,
    channels,
    normalised,
    scaled,
    sparse_rows,
    with_constants,
)


def _waves(size: int, phases: int) -> Floats:
    """Signals (frames, size) of columns or rows, -1 to 1, which no other place has, and all of them orthogonal.

    With one phase each place has a frequency of its own; with two, places half the monitor apart share one, as its
    cosine and its sine.
    """
    frequencies = -(-size // phases)
    frames = 2 * frequencies + 2
    place = np.arange(size)
    turns = (place % frequencies + 1) * np.arange(frames)[:, None] / frames - place // frequencies / 4
    return np.cos(2 * np.pi * turns).astype(np.float32)


def _shown(across: Floats, down: Floats) -> Pictures:
    columns, rows = across.shape[1], down.shape[1]
    vertical = np.broadcast_to(across[:, None, :], (len(across), rows, columns))
    horizontal = np.broadcast_to(down[:, :, None], (len(down), rows, columns))
    return np.round(127.5 + 127.5 * np.concatenate([vertical, horizontal])).astype(np.uint8)[..., None]


def _marginal(values: Floats, waves: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """The share (n, size) of each column's or row's light from the signals (n, frames), 0 where it may be noise, and
    the shares' own noise (n,)."""
    share = (2 * values - 1) @ waves * np.float32(2 / len(waves))
    noise = 2 * sigma * (2 / len(waves)) ** 0.5
    share[share < 3 * noise[:, None]] = 0
    return share, noise


def _outer(columns: Floats, rows: Floats) -> tuple[NDArray[np.intp], Floats]:
    """The pixels where a pixel's columns and rows cross, and the products of their shares, of sum 1."""
    x, y = np.flatnonzero(columns), np.flatnonzero(rows)
    weight = np.outer(rows[y], columns[x]).ravel()
    return (y[:, None] * len(columns) + x).ravel(), weight / max(weight.sum(), 1e-6)


class Frequencies:
    """J. Zhu and Y.-H. Yang, "Frequency-based environment matting", Pacific Graphics 2004.

    Each of the monitor's columns, then each of its rows, flickers at a frequency of its own, and the spectrum of a
    camera pixel's signal tells which of them it sees, and how much. All of this is the publication's. Left open or
    chosen here: a frame more than twice as many as frequencies need; the part of the spectrum in phase with the signal,
    which is less noisy than its magnitude; shares below three times the noise count as none; where several columns and
    rows are seen, the weight of a crossing is the product of both shares.
    """

    name = "Zhu 2004, frequencies"

    def program(self, columns: int, rows: int) -> Program:
        self.across, self.down = _waves(columns, 1), _waves(rows, 1)
        yield with_constants(_shown(self.across, self.down))

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        T = []
        for values, sigma in channels(shares, rho, film.noise):
            across, down = np.split(values, [len(self.across)], axis=1)
            x, y = _marginal(across, self.across, sigma)[0], _marginal(down, self.down, sigma)[0]
            T.append(sparse_rows(map(_outer, x, y), x.shape[1] * y.shape[1]))
        return scaled(still, rho, T)


class CompressedFrequencies:
    """Y. Qian, M. Gong and Y.-H. Yang, "Frequency-based environment matting by compressive sensing", ICCV 2015.

    Frequencies and phases tell the columns and rows that a pixel sees, with half as many frames as frequencies alone;
    compressive sensing tells the weights of their crossings from random patterns. Both are the publication's, as its
    abstract has them. Left open or chosen here, the text not being at hand: two phases, a quarter turn apart, for
    places half a monitor apart; 128 patterns of random pixels; weights by non-negative least squares over the
    crossings, the 1,200 likeliest at most, with the shares of columns and rows as further equations.
    """

    name = "Qian 2015, compressed frequencies"
    COUNT, MOST = 128, 1200

    def program(self, columns: int, rows: int) -> Program:
        self.across, self.down = _waves(columns, 2), _waves(rows, 2)
        self.bits = np.random.default_rng(3).integers(0, 2, (self.COUNT, rows * columns), np.uint8)
        random = 255 * self.bits.reshape(-1, rows, columns, 1)
        yield with_constants(np.concatenate([_shown(self.across, self.down), random]))

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        ends = np.cumsum([len(self.across), len(self.down)])
        T = []
        for values, sigma in channels(shares, rho, film.noise):
            across, down, random = np.split(values, ends, axis=1)
            x, of_x = _marginal(across, self.across, sigma)
            y, of_y = _marginal(down, self.down, sigma)
            rows = map(self._weights, x, y, random, of_x, of_y, sigma)
            T.append(sparse_rows(rows, x.shape[1] * y.shape[1]))
        return scaled(still, rho, T)

    def _weights(
        self, columns: Floats, rows: Floats, random: Floats, of_x: float, of_y: float, sigma: float
    ) -> tuple[NDArray[np.intp], Floats]:
        """The crossings that a pixel sees, and their weights."""
        place, likely = _outer(columns, rows)
        place = place[np.argsort(-likely, kind="stable")[: self.MOST]]
        if not place.size:
            return place, np.zeros(0, np.float32)
        y, x = np.divmod(place, len(columns))
        seen_x, seen_y = np.unique(x), np.unique(y)
        matrix = np.concatenate(
            [
                (2 * self.bits[:, place].astype(np.float64) - 1) / (2 * sigma),
                (x == seen_x[:, None]) / of_x,
                (y == seen_y[:, None]) / of_y,
            ]
        )
        target = np.concatenate([(2 * random - 1) / (2 * sigma), columns[seen_x] / of_x, rows[seen_y] / of_y])
        weight = nnls(matrix, target, maxiter=20 * place.size)[0]
        return place[weight > 0], weight[weight > 0].astype(np.float32)
