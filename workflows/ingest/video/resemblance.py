"""Whether what a recording shows is the program: what was seen of each pattern, against the light of the pattern."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from workflows.images.resample import area_mean
from workflows.images.tone_curves import Curve, to_light
from workflows.programs.program import Bernoulli, Constant, Program

Doubles = NDArray[np.float64]
Light = NDArray[np.float32]
"""(patterns, rows, columns, 3) float32: the light of patterns on a grid over the monitor."""

GRIDS = ((4, 3), (8, 6), (16, 12), (32, 24))
"""On which patterns are compared: how much of the monitor a cell of a frame sees is not known."""
FEWEST = 8
"""Patterns of a part that are compared with one another: the orders of fewer look too much alike."""
_ORDERS = 64
_ODD = 5.0
_APART = 0.1


def lay_out(program: Program, curve: Curve, images: Sequence[NDArray[np.float32]] = ()) -> Light:
    """The light of every pattern of a program on the finest of `GRIDS`."""
    columns, rows = GRIDS[-1]
    laid = np.empty((program.count, rows, columns, 3), np.float32)
    for start, part in zip(program.starts, program.parts, strict=False):
        if isinstance(part, Bernoulli) and part.offset:
            laid[start : start + part.count] = list(part.means(program.monitor, columns, rows))
        elif isinstance(part, Constant):
            laid[start : start + part.count] = to_light(part.values, curve)[:, None, None]
        else:
            values = program.values(start, start + part.count, images)
            laid[start : start + part.count] = [area_mean(to_light(v, curve), columns, rows) for v in values]
    return laid


def resemblance(program: Program, light: Light, looks: Mapping[int, Doubles]) -> float | None:
    """Whether patterns that are alike look alike, more than they would in another order.

    Parameters
    ----------
    program : Program
    light : Light
        Of all its patterns.
    looks : mapping of int to (rows, columns, 3) float64
        What the camera saw of patterns, about in linear light.

    Returns
    -------
    float or None
        Standard deviations above what random orders of the patterns give; about 0 of another program. None if the
        program has too few patterns to tell.

    Notes
    -----
    Within each part, the inner products of the patterns, on several grids, are summed over those of the looks (an
    alignment of kernels, Cristianini et al., 2001; without the diagonals). Nothing needs to be known of what the cells
    of a frame see. Parts count by how much of their contrast the grids show.
    """
    total = weights = 0.0
    for numbers in _parts(program, looks):
        seen = _products(np.stack([looks[number].ravel() for number in numbers]))
        shown = np.zeros_like(seen)
        for columns, rows in GRIDS:
            laid = np.stack([area_mean(light[number], columns, rows).ravel() for number in numbers])
            shown += _products(laid.astype(np.float64))
        random = np.random.Generator(np.random.PCG64(0))
        orders = (random.permutation(len(numbers)) for _ in range(_ORDERS))
        chance = [float((shown[np.ix_(order, order)] * seen).sum()) for order in orders]
        weight = float(light[numbers].std(axis=0).mean())
        total += (
            weight
            * (float((shown * seen).sum()) - float(np.mean(chance)))
            / max(float(np.std(chance)), 1e-12)
        )
        weights += weight**2
    return float(total / np.sqrt(weights)) if weights else None


def odd(program: Program, light: Light, looks: Mapping[int, Doubles]) -> list[int]:
    """The patterns that look unlike others of their kind: something was in front, or they are others.

    Random patterns that are farther from the mean of their part than any should be, and constant ones that are darker
    than most of those that are sent less.
    """
    found = []
    for numbers in _parts(program, looks):
        seen = np.stack([looks[number].ravel() for number in numbers])
        far = ((seen - np.median(seen, axis=0)) ** 2).sum(axis=1)
        found += [number for number, much in zip(numbers, far, strict=True) if much > _ODD * np.median(far)]
    constants = [number for number in program.constants[0].tolist() if number in looks]
    sent = light[constants].mean(axis=(1, 2, 3))
    bright = np.array([looks[number].mean() for number in constants])
    apart = np.abs(sent[:, None] - sent) > _APART
    wrong = apart & ((sent[:, None] > sent) != (bright[:, None] > bright))
    found += [number for number, much in zip(constants, wrong.sum(1) > apart.sum(1) / 2, strict=True) if much]
    return sorted(found)


def _parts(program: Program, looks: Mapping[int, Doubles]) -> Iterator[list[int]]:
    """The patterns seen of each part of random ones that has enough of them."""
    for start, part in zip(program.starts, program.parts, strict=False):
        numbers = [number for number in range(start, start + part.count) if number in looks]
        if isinstance(part, Bernoulli) and len(numbers) >= FEWEST:
            yield numbers


def _products(rows: Doubles) -> Doubles:
    """Inner products of rows that are centred and of unit length, those with themselves left out."""
    rows = rows - rows.mean(axis=0)
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
    products: Doubles = rows @ rows.T
    np.fill_diagonal(products, 0)
    return products
