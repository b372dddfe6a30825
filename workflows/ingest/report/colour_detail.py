"""The detail of colours that films and JPEGs lose: they store colour at half the resolution of brightness (4:2:0)."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Shares of red, green and blue in the brightness, ITU-R BT.709-6, 3.2."""


class ColourDetail:
    """Estimates the lost detail from all pictures that it is given.

    Notes
    -----
    Let D_n be the mean squared difference of blocks of n x n pixels from those of 2n x 2n that hold them. D_1 of the
    colours is lost, but D_2 is not. If colours have a spectrum like that of brightness Y, D_1 was ``D_2 D_1(Y) /
    D_2(Y)``.
    """

    def __init__(self) -> None:
        self._squares = np.zeros(3)  # D_1 and D_2 of the brightness, D_2 of the colours
        self._blocks = np.zeros(2)

    def add(self, light: Floats, wanted: NDArray[np.bool_]) -> None:
        """Take pictures into account.

        Parameters
        ----------
        light : (n, height, width, 3) float32
        wanted : (height, width) bool
            The pixels that count.
        """
        brightness = light @ LUMA
        values = np.concatenate([brightness[..., np.newaxis], light - brightness[..., np.newaxis]], axis=3)
        for at, size in enumerate((1, 2)):
            inside = _means(wanted[np.newaxis, :, :, np.newaxis].astype(np.float32), 2 * size)[0, ..., 0] == 1
            fine, coarse = _means(values, size), _means(values, 2 * size)
            whole = tuple(slice(2 * n) for n in coarse.shape[1:3])
            apart = fine[:, *whole] - coarse.repeat(2, axis=1).repeat(2, axis=2)
            square = (apart[:, inside.repeat(2, axis=0).repeat(2, axis=1)] ** 2).sum(axis=(0, 1))
            self._squares[at] += square[0]
            self._blocks[at] += len(light) * 4 * np.count_nonzero(inside)
            if size == 2:
                self._squares[2] += square[1:].mean()

    def lost(self) -> float:
        """The mean square of what is lost, in the units of the light squared; 0 where nothing tells it."""
        if not self._blocks.all():
            return 0.0
        fine, coarse, colour = self._squares / self._blocks[[0, 1, 1]]
        return float(colour * fine / coarse) if coarse > 0 else 0.0


def _means(values: Floats, size: int) -> Floats:
    """The means of blocks of ``size x size`` pixels; incomplete ones are left out."""
    count, height, width, channels = values.shape
    rows, columns = height // size, width // size
    blocks = values[:, : rows * size, : columns * size].reshape(count, rows, size, columns, size, channels)
    means: Floats = blocks.mean(axis=(2, 4))
    return means
