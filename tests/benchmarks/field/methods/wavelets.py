"""Wavelet patterns: Peers and Dutré 2003 and 2005."""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from tests.benchmarks.field.methods.method import (
    CONSTANTS,
    Film,
    Floats,
    Matte,
    Pictures,
    Program,
    channels,
    normalised,
    scaled,
    with_constants,
)

LEVELS = 6
"""Levels of wavelets: blocks of 64 pixels are the coarsest."""
GREY = 127
"""The value that a wavelet is shown about, and its amplitude."""


def haar(across: int, down: int, levels: int) -> list[sp.csr_array]:
    """The two-dimensional Haar basis of a grid, level by level from coarse to fine.

    Returns
    -------
    list of (functions, across * down) float32
        First the blocks of 2 ** levels cells, then for each block, from those to blocks of 2 x 2 cells, its three
        wavelets: halves side by side, halves one above the other, and quarters. Values are 1 and -1. Blocks are in the
        order of rows, and a block's wavelets are neighbours.
    """
    y, x = np.divmod(np.arange(across * down), across)
    found = []
    for level in range(levels, 0, -1):
        side = 1 << level
        block = y // side * (across // side) + x // side
        ones = np.ones(block.size, np.float32)
        shape = across // side * (down // side), block.size
        if level == levels:
            found.append(sp.csr_array((ones, (block, np.arange(block.size))), shape=shape))
        right, low = (1 - 2 * (at * 2 // side % 2).astype(np.float32) for at in (x, y))
        rows = np.stack([3 * block + kind for kind in range(3)])
        values = np.stack([right, low, right * low])
        places = np.broadcast_to(np.arange(block.size), rows.shape)
        found.append(
            sp.csr_array((values.ravel(), (rows.ravel(), places.ravel())), shape=(3 * shape[0], shape[1]))
        )
    return found


def _shown(functions: Floats, columns: int, rows: int) -> Pictures:
    """Functions (k, pixels), -1 to 1, as pictures about a medium grey."""
    return np.round(GREY + GREY * functions).astype(np.uint8).reshape(-1, rows, columns, 1)


def _responses(shares: Floats) -> Floats:
    """T's products with the functions, from the shares of white's light."""
    return shares * np.float32(255 / GREY) - 1


def _children(blocks: NDArray[np.intp], across: int) -> NDArray[np.intp]:
    """The four blocks (..., 4) of the next level that each block is split into; `across` of its level are in a row."""
    y, x = np.divmod(blocks[..., None], across)
    down, right = np.divmod(np.arange(4), 2)
    return (2 * y + down) * 2 * across + 2 * x + right


class Wavelets:
    """P. Peers and P. Dutré, "Wavelet environment matting", Eurographics Symposium on Rendering 2003.

    Each frame shows one wavelet. A feedback loop chooses the next ones: the children of those whose frames have most
    light, by the norm over all pixels. The matte holds the pixels' responses to the wavelets shown. All of this is the
    publication's. Left open or chosen here: Haar's wavelets, shown about a medium grey, where the publication has
    smoother ones and weighs levels by an exponent, which is 0 here, as suits backdrops like photographs; blocks of 64
    pixels to begin with; 64 wavelets a round, 1,000 in all. Responses below three times the noise count as none.
    """

    name = "Peers 2003, wavelets"
    COUNT, ROUND = 1000, 64

    def program(self, columns: int, rows: int) -> Program:
        levels = haar(columns, rows, LEVELS)
        basis = sp.vstack(levels, format="csr")
        starts = np.cumsum([0, *(level.shape[0] for level in levels)])
        across = [columns >> LEVELS << max(level - 1, 0) for level in range(len(levels))]
        chosen = np.arange(starts[2])
        values = yield with_constants(_shown(basis[chosen].toarray(), columns, rows))
        constants, found = values[:, :CONSTANTS], values[:, CONSTANTS:]
        shown, waiting = [chosen], {}
        while True:
            film = np.concatenate([constants, found], axis=1)
            power = _importance(film)
            for number, of in zip(chosen, power, strict=True):
                level = int(np.searchsorted(starts, number, side="right")) - 1
                if 1 <= level < LEVELS:
                    block, kind = divmod(int(number) - starts[level], 3)
                    for child in _children(np.array(block), across[level]):
                        waiting[int(starts[level + 1] + 3 * child + kind)] = float(of)
            room = min(self.ROUND, self.COUNT - sum(map(len, shown)))
            chosen = np.array(sorted(sorted(waiting), key=waiting.__getitem__, reverse=True)[:room], int)
            if not chosen.size:
                break
            for number in chosen:
                del waiting[int(number)]
            shown.append(chosen)
            found = yield _shown(basis[chosen].toarray(), columns, rows)
        functions = basis[np.concatenate(shown)]
        self.basis = sp.diags_array(1 / np.diff(functions.indptr)) @ functions

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        T = []
        for values, sigma in channels(shares, rho, film.noise):
            response = _responses(values)
            response[np.abs(response) < 3 * 255 / GREY * sigma[:, None]] = 0
            T.append(sp.csr_array(response))
        return scaled(still, rho, T, self.basis)


class WaveletNoise:
    """P. Peers and P. Dutré, "Inferring reflectance functions from wavelet noise", Eurographics Symposium on Rendering
    2005.

    Patterns that do not depend on the scene: each shows all wavelets of one level with random weights. A pixel's
    coefficients are found from coarse to fine: only wavelets whose parents matter can matter, and these are fitted to
    the level's frames. All of this is the publication's. Left open or chosen here: Haar's wavelets; weights of 1 and
    -1, which are brightest; 32 patterns of blocks of 64 pixels and 80 of each of the six levels; as many blocks are
    split as have over 1 % of the light, a sixth of the level's patterns at most.
    """

    name = "Peers 2005, wavelet noise"
    BLOCKS, COUNT = 32, 80

    def program(self, columns: int, rows: int) -> Program:
        rng = np.random.default_rng(5)
        self.levels = haar(columns, rows, LEVELS)
        self.weights, pictures = [], []
        for level, functions in enumerate(self.levels):
            count = self.COUNT if level else self.BLOCKS
            weights = rng.choice(np.array([-1, 1], np.float32), (count, functions.shape[0]))
            shown = weights @ functions / (3 if level else 1)
            self.weights.append(weights)
            pictures.append(_shown(shown, columns, rows))
        yield with_constants(np.concatenate(pictures))

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        columns, _ = film.size
        T = [
            self._solve(_responses(values), columns >> LEVELS)
            for values, _ in channels(shares, rho, film.noise)
        ]
        functions = sp.vstack(self.levels, format="csr")
        return scaled(still, rho, T, sp.diags_array(1 / np.diff(functions.indptr)) @ functions)

    def _solve(self, responses: Floats, across: int) -> sp.csr_array:
        """Products (n, functions) of T with all wavelets, most of them 0."""
        ends = np.cumsum([self.BLOCKS, *[self.COUNT] * LEVELS])
        found = [np.zeros((len(responses), level.shape[0]), np.float32) for level in self.levels]
        for pixel, response in enumerate(responses):
            frames = np.split(response, ends[:-1])
            mass = np.linalg.lstsq(self.weights[0], frames[0], rcond=None)[0]
            found[0][pixel] = mass
            blocks = np.arange(mass.size)
            for level in range(1, LEVELS + 1):
                largest = np.argsort(-mass)[: self.COUNT // 6]
                kept = largest[mass[largest] > 0.01]
                blocks, mass = blocks[kept], mass[kept]
                if not blocks.size:
                    break
                own = (3 * blocks[:, None] + np.arange(3)).ravel()
                fitted = np.linalg.lstsq(self.weights[level][:, own] / 3, frames[level], rcond=None)[0]
                found[level][pixel, own] = fitted
                right, low, both = fitted.reshape(-1, 3).T[..., None]
                x, y = np.array([1, -1, 1, -1]), np.array([1, 1, -1, -1])
                mass = ((mass[:, None] + x * right + y * low + x * y * both) / 4).ravel()
                blocks = _children(blocks, across << level - 1).ravel()
        return sp.csr_array(np.concatenate(found, axis=1))


def _importance(values: Floats) -> Floats:
    """The importance (k,) of wavelets, the mean square of the responses in frames after constant ones."""
    black, white = (values[:, first:CONSTANTS:2].mean(axis=1) for first in (0, 1))
    rho = np.maximum(white - black, 1e-3)
    response = _responses((values[:, CONSTANTS:] - black[:, None]) / rho[:, None])
    return (response**2).mean(axis=(0, 2))
