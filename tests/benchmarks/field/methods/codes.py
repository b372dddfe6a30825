"""Stripes that code places: Gray code with one correspondence, and Zongker et al. 1999."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.field.methods.method import (
    Film,
    Floats,
    Matte,
    Pictures,
    Program,
    grey,
    normalised,
    scaled,
    sparse_rows,
    with_constants,
)


def _bits(size: int) -> int:
    return int(size - 1).bit_length()


def _stripes(codes: NDArray[np.intp], bits: int) -> NDArray[np.uint8]:
    """(bits, places) uint8, 0 or 1: the bits of each place's code, from coarse to fine."""
    return (codes >> np.arange(bits - 1, -1, -1)[:, None] & 1).astype(np.uint8)


def _on_monitor(columns: NDArray[np.uint8], rows: NDArray[np.uint8]) -> Pictures:
    """Patterns (m, rows, columns, 1) of vertical stripes (k, columns) and then of horizontal ones (l, rows)."""
    wide, high = columns.shape[1], rows.shape[1]
    vertical = np.broadcast_to(columns[:, None, :], (len(columns), high, wide))
    horizontal = np.broadcast_to(rows[:, :, None], (len(rows), high, wide))
    return np.concatenate([vertical, horizontal])[..., None]


class GrayCode:
    """One place for each pixel, as maps of u and v have it (STMap; the input of TOM-Net and of DRT).

    Each pattern is followed by its inverse, so that a bit is the sign of a difference and needs no threshold.
    """

    name = "Gray code, one place"

    def program(self, columns: int, rows: int) -> Program:
        coded = [_stripes(at ^ at >> 1, _bits(at.size)) for at in (np.arange(columns), np.arange(rows))]
        plain = 255 * _on_monitor(*coded)
        yield with_constants(np.stack([plain, 255 - plain], axis=1).reshape(-1, rows, columns, 1))

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        value = grey(shares, rho)
        bits = (value[:, ::2] > value[:, 1::2]).astype(np.intp)
        columns, rows = film.size
        x, y = (
            np.minimum(_decoded(part), size - 1)
            for part, size in zip(np.split(bits, [_bits(columns)], axis=1), (columns, rows), strict=True)
        )
        T = sparse_rows(((np.array([at]), np.ones(1)) for at in y * columns + x), columns * rows)
        return scaled(still, rho, [T])


def _decoded(gray: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers (n,) of Gray codes (n, bits), the coarsest bit first."""
    plain = np.bitwise_xor.accumulate(gray, axis=1)
    return plain @ (1 << np.arange(gray.shape[1] - 1, -1, -1))


class Zongker:
    """D. Zongker, D. Werner, B. Curless and D. Salesin, "Environment matting and compositing", SIGGRAPH 1999.

    Vertical and horizontal stripes of magenta and green, each pattern with twice as many as the one before, and a
    search for the axis-aligned rectangle whose mean explains the frames; one rectangle for all channels, each axis on
    its own. Both are the publication's. Left open: the search (it is exhaustive here, over all intervals), the number
    of patterns (down to stripes of one pixel), and the solid frames (black and white here, so that S and rho are those
    of all other methods; the publication takes its foreground and alpha from solid magenta and green). The object fills
    its pixels, so its alpha is 1; there is one monitor and no sidedrops.
    """

    name = "Zongker 1999, rectangles"

    def program(self, columns: int, rows: int) -> Program:
        stripes = _on_monitor(*(_stripes(np.arange(size), _bits(size)) for size in (columns, rows)))
        magenta = 255 * stripes
        yield with_constants(np.concatenate([magenta, 255 - magenta, magenta], axis=3))

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        shares[..., 1] = 1 - shares[..., 1]
        columns, rows = film.size
        stripes = _on_monitor(*(_stripes(np.arange(size), _bits(size)) for size in (columns, rows)))
        return Stripes(stripes.astype(np.float32)).recover(shares, still, rho)


class Stripes:
    """The rectangle that explains stripes best, by a search of all intervals of each axis on its own.

    Parameters
    ----------
    pictures : sequence of (rows, columns, 1) float32
        Vertical or horizontal stripes, 0 to 1.
    widest : int, optional
        Of a rectangle; as wide as the monitor if left out.
    """

    def __init__(self, pictures: Sequence[Floats], widest: int | None = None) -> None:
        self._size = pictures[0].shape[:2]
        lines = [picture[..., 0] for picture in pictures]
        vertical = [bool((line[0] != line[0, 0]).any()) for line in lines]
        self._use = [np.flatnonzero(vertical), np.flatnonzero(np.logical_not(vertical))]
        across, down = ([lines[i] for i in use] for use in self._use)
        self._lines = [np.stack([one[0] for one in across]), np.stack([one[:, 0] for one in down])]
        self._widest = widest

    def recover(self, shares: Floats, still: Floats, rho: Floats) -> Matte:
        """One rectangle for all channels, from the patterns' values (n, m, 3) as shares of white."""
        value = grey(shares, rho)
        across, down = (
            _interval(value[:, use], lines, self._widest)
            for use, lines in zip(self._use, self._lines, strict=True)
        )
        rows, columns = self._size
        rectangles = []
        for left, right, top, bottom in np.concatenate([across, down], axis=1):
            y, x = np.mgrid[top:bottom, left:right]
            rectangles.append(((y * columns + x).ravel(), np.full(x.size, 1 / x.size)))
        return scaled(still, rho, [sparse_rows(rectangles, columns * rows)])


def _interval(value: Floats, lines: Floats, widest: int | None) -> NDArray[np.intp]:
    """First places of the best intervals, and the places after their last, (n, 2), of lines (m, places)."""
    size = lines.shape[1]
    total = np.concatenate([np.zeros((1, len(lines))), np.cumsum(lines.T, axis=0, dtype=np.float64)])
    first, last = np.triu_indices(size + 1, 1)
    if widest is not None:
        first, last = (end[last - first <= widest] for end in (first, last))
    mean = (total[last] - total[first]) / (last - first)[:, None]
    square = (mean**2).sum(axis=1)
    best = np.array([(square - 2 * mean @ one).argmin() for one in value.astype(np.float64)])
    return np.stack([first[best], last[best]], axis=1)
