"""What a method of the benchmark is: patterns to show, and a matte from the frames of them.

A method to compare with the others is a class like `Method`, and a line in `rivals.METHODS`.
"""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Pictures = NDArray[np.uint8]
Program = Generator[Pictures, Floats, None]


class Matte(Protocol):
    """What a method recovers."""

    @property
    def bytes(self) -> int:
        """The memory that it takes."""

    def composite(self, light: Floats) -> Floats:
        """The light (n, 3) of the pixels before a backdrop (rows, columns, 3) of the monitor's size."""


class Method(Protocol):
    """A way to measure a matte."""

    name: str

    def program(self, columns: int, rows: int) -> Program:
        """Yield the patterns (m, rows, columns, 1 or 3) to show on a monitor, 0 to 255.

        The monitor's light is in proportion to them. Each ``yield`` is answered with the frames (n, m, 3) of these
        patterns, so that a method may choose what it shows next.
        """

    def recover(self, film: "Film") -> Matte:
        """Recover the matte from all frames."""


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of a method's patterns.

    Attributes
    ----------
    pictures : (m, rows, columns, 1 or 3) uint8
    values : (n, m, 3) float32
        Of n pixels of the object, 1 where the camera clips.
    tiles : (n,) int
        The square of neighbouring pixels that each is of.
    noise : float
        About its standard deviation in a frame: what the rivals take it to be.
    step : float
        The distance of two values that the camera tells apart.
    """

    pictures: Sequence[Pictures]
    values: Floats
    tiles: NDArray[np.intp]
    noise: float
    step: float

    @property
    def size(self) -> tuple[int, int]:
        """The monitor's columns and rows."""
        rows, columns = self.pictures[0].shape[:2]
        return columns, rows


@dataclass(frozen=True, eq=False)
class Rows:
    """A matte of matrices.

    Attributes
    ----------
    still : (n, 3) float32
        Light not from the monitor.
    transport : three (n, k) float32 CSR arrays
        rho T of each channel: shares of the k functions' light.
    basis : (k, monitor pixels) float32 CSR array, optional
        The functions, if they are not the monitor's pixels.
    """

    still: Floats
    transport: tuple[sp.csr_array, ...]
    basis: sp.csr_array | None = None

    @property
    def bytes(self) -> int:
        """An entry is a number and a place of 32 bits each; channels with the same matrix share it. The basis is a
        formula's."""
        different = {id(channel): channel for channel in self.transport}
        return self.still.nbytes + sum(8 * channel.nnz for channel in different.values())

    def composite(self, light: Floats) -> Floats:
        flat = light.reshape(-1, 3)
        if self.basis is not None:
            flat = self.basis @ flat
        return self.still + np.stack([T @ flat[:, c] for c, T in enumerate(self.transport)], axis=1)


CONSTANTS = 4
"""Constant frames that the rivals' programs begin with."""


COLOURLESS = 0.05
"""Glass whose rho differs less than this between the channels has one T for all of them."""


def with_constants(pictures: Pictures) -> Pictures:
    """Patterns after two black and two white frames, from which `normalised` takes S and rho."""
    levels = np.array([0, 255, 0, 255], np.uint8).reshape(-1, 1, 1, 1)
    return np.concatenate([np.broadcast_to(levels, (CONSTANTS, *pictures.shape[1:])), pictures])


def normalised(film: Film) -> tuple[Floats, Floats, Floats]:
    """S and rho (n, 3), and the patterns' values (n, m, 3) as shares of white."""
    black, white = (film.values[:, first:CONSTANTS:2].mean(axis=1) for first in (0, 1))
    rho = np.maximum(white - black, 1e-3)
    return black, rho, (film.values[:, CONSTANTS:] - black[:, None]) / rho[:, None]


def grey(shares: Floats, rho: Floats) -> Floats:
    """One value (n, m) of three channels (n, m, 3), the brighter ones counting for more."""
    weight = rho / rho.sum(axis=1, keepdims=True)
    return np.einsum("nmc,nc->nm", shares, weight)


def channels(shares: Floats, rho: Floats, noise: float) -> list[tuple[Floats, Floats]]:
    """The values (n, m) that tell T, and their noise (n,): of all channels together where the glass has no colour,
    else of each."""
    if np.ptp(rho, axis=1).max() < COLOURLESS:
        return [(grey(shares, rho), noise / rho.mean(axis=1) / 3**0.5)]
    return [(shares[..., c], noise / rho[:, c]) for c in range(3)]


def scaled(still: Floats, rho: Floats, T: Sequence[sp.csr_array], basis: sp.csr_array | None = None) -> Rows:
    """A matte of one T for all channels or one for each, without rho."""
    if len(T) == 1 and (rho == rho[:, :1]).all():
        T = [sp.diags_array(rho[:, 0]) @ T[0]] * 3
    else:
        T = [sp.diags_array(rho[:, c]) @ T[min(c, len(T) - 1)] for c in range(3)]
    return Rows(still, tuple(T), basis)


def sparse_rows(rows: Iterable[tuple[NDArray[np.intp], Floats]], cells: int) -> sp.csr_array:
    """A matrix of rows of places and weights."""
    listed = list(rows)
    begin = np.cumsum([0, *(len(place) for place, _ in listed)])
    place, weight = (np.concatenate(part) for part in zip(*listed, strict=True))
    return sp.csr_array((weight.astype(np.float32), place, begin), shape=(len(listed), cells))


def spread(columns: int, rows: int, across: int, down: int) -> sp.csr_array:
    """The matrix (cells, monitor pixels) that spreads the weights of a grid's cells over the pixels of each."""
    y, x = np.divmod(np.arange(columns * rows), columns)
    cell = y * down // rows * across + x * across // columns
    weight = 1 / np.bincount(cell)[cell]
    shape = (across * down, columns * rows)
    return sp.csr_array((weight.astype(np.float32), (cell, np.arange(cell.size))), shape=shape)
