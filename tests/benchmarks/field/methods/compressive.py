"""Random patterns and linear algebra: the dense pseudo-inverse, and compressive light transport of 2009."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from tests.benchmarks.field.methods.method import (
    Film,
    Floats,
    Matte,
    Program,
    channels,
    normalised,
    scaled,
    sparse_rows,
    spread,
    with_constants,
)
from tests.benchmarks.field.methods.wavelets import LEVELS, haar


@dataclass
class PseudoInverse:
    """All weights of a coarse grid by the pseudo-inverse of more patterns than it has cells.

    As in the public programs for light transport matrices: no prior, each channel on its own. The grid is as fine as
    the frames allow: 1.3 patterns for each cell, because a square random matrix amplifies the noise without bound.
    """

    name: str = "pseudo-inverse, dense"
    grid: tuple[int, int] = (32, 24)
    count: int = 1000

    def program(self, columns: int, rows: int) -> Program:
        wide, high = self.grid
        self.bits = np.random.default_rng(11).integers(0, 2, (self.count, high, wide), np.uint8)
        down, across = np.arange(rows) * high // rows, np.arange(columns) * wide // columns
        yield with_constants(255 * self.bits[:, down][:, :, across][..., None])

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        inverse = np.linalg.pinv(self.bits.reshape(self.count, -1).astype(np.float32))
        weights = np.einsum("km,nmc->cnk", inverse, shares, optimize=True)
        return scaled(
            still, rho, [sp.csr_array(weight) for weight in weights], spread(*film.size, *self.grid)
        )


class CompressiveDual:
    """P. Sen and S. Darabi, "Compressive dual photography", Eurographics 2009.

    Random patterns of the monitor's pixels, and each channel of a pixel as a sparse sum of wavelets, by regularised
    orthogonal matching pursuit (D. Needell and R. Vershynin, Found. Comput. Math., 2009). Both are the publication's.
    Left open or chosen here: Haar's wavelets; 1,000 patterns; 12 wavelets a step; an end at the noise's own residual,
    at 160 wavelets, or where the residual no longer falls.
    """

    name = "Sen 2009, ROMP"
    COUNT = 1000

    def program(self, columns: int, rows: int) -> Program:
        bits = np.random.default_rng(13).integers(0, 2, (self.COUNT, rows * columns), np.uint8)
        functions = sp.vstack(haar(columns, rows, LEVELS), format="csr")
        # Of length 1, so that correlations compare.
        self.basis = sp.diags_array(np.diff(functions.indptr).astype(np.float32) ** -0.5) @ functions
        signs = 2 * bits.T.astype(np.float32) - 1
        # The white frame is a measurement too, and as good as all others together.
        white = np.full((len(signs), 1), self.COUNT**0.5, np.float32)
        self.matrix = np.ascontiguousarray((self.basis @ np.concatenate([signs, white], axis=1)).T)
        yield with_constants(255 * bits.reshape(-1, rows, columns, 1))

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        T = []
        for values, sigma in channels(shares, rho, film.noise):
            white = np.full((len(values), 1), self.COUNT**0.5, np.float32)
            T.append(self.solve(np.concatenate([2 * values - 1, white], axis=1), 2 * sigma, film))
        return scaled(still, rho, T, self.basis)

    def solve(self, target: Floats, sigma: Floats, film: Film) -> sp.csr_array:
        """Coefficients (n, functions) of targets (n, m) with noise (n,)."""
        return romp(self.matrix, target, sigma, [np.zeros(0, np.intp)] * len(target))


class CompressiveTransport(CompressiveDual):
    """P. Peers, D. Mahajan, B. Lamond, A. Ghosh, W. Matusik, R. Ramamoorthi and P. Debevec, "Compressive light
    transport sensing", ACM Transactions on Graphics 28(1), 2009.

    As Sen and Darabi, but hierarchical: the mean of a square of pixels is solved for first, and each quarter of it
    starts from the wavelets of the whole. It is the publication's idea. Left open or chosen here: squares of 4 x 4
    pixels, quarters of them, and pixels; the 40 largest coefficients of the whole are what a part starts from; the
    patterns are those of the method above, not the publication's, which are made to suit its own projector.
    """

    name = "Peers 2009, hierarchical ROMP"
    KEPT = 40

    def solve(self, target: Floats, sigma: Floats, film: Film) -> sp.csr_array:
        n = len(target)
        order = np.arange(n) - np.searchsorted(film.tiles, film.tiles)
        quarter = order // 8 * 2 + order % 4 // 2
        groups = (film.tiles, 4 * film.tiles + quarter, np.arange(n))
        start = [np.zeros(0, np.intp)] * n
        for group in groups:
            _, first, own, size = np.unique(group, return_index=True, return_inverse=True, return_counts=True)
            mean = sp.csr_array((1 / size[own], (own, np.arange(n))), shape=(size.size, n))
            noise = mean @ sigma / size**0.5
            found = romp(self.matrix, mean @ target, noise, [start[pixel] for pixel in first])
            start = [self._largest(found, row) for row in own]
        return found

    def _largest(self, found: sp.csr_array, row: int) -> NDArray[np.intp]:
        """The places of a row's largest coefficients."""
        inside = slice(*found.indptr[row : row + 2])
        order = np.argsort(-np.abs(found.data[inside]), kind="stable")[: self.KEPT]
        return np.sort(found.indices[inside][order])


def romp(
    matrix: Floats,
    target: Floats,
    sigma: Floats,
    start: Sequence[NDArray[np.intp]],
    step: int = 12,
    most: int = 160,
) -> sp.csr_array:
    """Solve for sparse coefficients (n, k) of matrix (m, k), so that the residuals to targets (n, m) are noise.

    Each step takes the coefficients with the largest correlations, of these the group with most energy whose members
    differ by a factor of 2 at most, and fits all that were taken. A start is a support to begin with.
    """
    m = len(matrix)
    support, weight = list(start), [np.zeros(len(one), np.float32) for one in start]
    residual = target.astype(np.float32)
    before = np.full(len(target), np.inf)
    open_rows = np.flatnonzero([len(one) > 0 for one in support])
    for turn in range(most):
        if turn:
            correlation = np.abs(residual[open_rows] @ matrix)
            best = np.argpartition(-correlation, step, axis=1)[:, :step]
            for row, among, of in zip(open_rows, best, correlation, strict=True):
                support[row] = np.union1d(support[row], _comparable(among, of[among]))
        for row in open_rows:
            chosen = matrix[:, support[row]]
            gram = chosen.T @ chosen
            gram[np.diag_indices_from(gram)] += 1e-3 * m
            weight[row] = np.linalg.solve(gram, chosen.T @ target[row])
            residual[row] = target[row] - chosen @ weight[row]
        power = (residual.astype(np.float64) ** 2).mean(axis=1)
        size = np.array([len(one) for one in support])
        open_rows = np.flatnonzero((power > sigma**2) & (size < most) & (power < 0.99 * before))
        if not open_rows.size:
            break
        before = power
    return sparse_rows(zip(support, weight, strict=True), matrix.shape[1])


def _comparable(places: NDArray[np.intp], sizes: Floats) -> NDArray[np.intp]:
    """Of some places, the group with most energy whose sizes differ by a factor of 2 at most."""
    order = np.argsort(-sizes)
    places, sizes = places[order], sizes[order]
    ends = np.searchsorted(-sizes, -sizes / 2, side="right")
    energy = np.append(0, np.cumsum(sizes.astype(np.float64) ** 2))
    first = int(np.argmax(energy[ends] - energy[:-1]))
    return places[first : ends[first]]
