"""Whether a recording shows the program: what the camera saw of each pattern, compared with the pattern's light."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from workflows.images.resample import area_mean
from workflows.images.tone_curves import Curve, to_light
from workflows.programs.parts import Bernoulli, Constant, Halftone
from workflows.programs.program import Program

Doubles = NDArray[np.float64]
Light = NDArray[np.float32]
"""(patterns, rows, columns, 3) float32: the light of each pattern on a grid over the monitor."""

GRIDS = ((4, 3), (8, 6), (16, 12), (32, 24))
"""Grids on which patterns are compared: several, because it is not known how much of the monitor a cell sees."""
MIN_PATTERNS = 8
"""Patterns that a part must have to be compared: random orders of fewer look too much alike."""
_ORDERS = 64  # random orders to compare with
_ODD = 5.0  # times the median squared distance from the part's mean: an odd pattern
_APART = 0.1  # difference of light from which one constant pattern must look brighter than the other


def coarse_light(program: Program, curve: Curve, images: Sequence[NDArray[np.float32]]) -> Light:
    """The light of every pattern of a program on the finest of `GRIDS`."""
    columns, rows = GRIDS[-1]
    laid = np.empty((program.count, rows, columns, 3), np.float32)
    for start, part in zip(program.starts, program.parts, strict=False):
        if isinstance(part, Bernoulli) and part.offset:
            laid[start : start + part.count] = list(part.means(program.monitor, columns, rows))
        elif isinstance(part, Constant):
            laid[start : start + part.count] = to_light(part.values, curve)[:, None, None]
        elif isinstance(part, Halftone):
            laid[start : start + part.count] = np.array(part.levels)[:, None, None, None]
        else:
            values = program.values(start, start + part.count, images)
            laid[start : start + part.count] = [area_mean(to_light(v, curve), columns, rows) for v in values]
    return laid


def score(program: Program, light: Light, looks: Mapping[int, Doubles]) -> float | None:
    """How much better similar patterns look similar than they would in a random order.

    Parameters
    ----------
    program : Program
    light : Light
        Of all its patterns, see `coarse_light`.
    looks : mapping of int to (rows, columns, 3) float64
        What the camera saw of patterns, in approximately linear light.

    Returns
    -------
    float or None
        Standard deviations above the mean of random orders; about 0 for another program. None if the program has too
        few patterns to compare.

    Notes
    -----
    Within each part and channel, the inner products of pairs of patterns, on several grids, are correlated with those
    of pairs of looks (a kernel alignment without the diagonals, Cristianini et al., 2001). It is not necessary to know
    what part of the monitor a cell of the frame sees. Parts are weighted by how much of their contrast the grids show.
    """
    total = weights = 0.0
    for numbers in _parts(program, looks):
        seen = _products(np.stack([looks[number] for number in numbers]))
        shown = np.zeros_like(seen)
        for columns, rows in GRIDS:
            laid = np.stack([area_mean(light[number], columns, rows) for number in numbers])
            shown += _products(laid.astype(np.float64))
        random = np.random.Generator(np.random.PCG64(0))
        orders = (random.permutation(len(numbers)) for _ in range(_ORDERS))
        chance = [float((shown[:, order][:, :, order] * seen).sum()) for order in orders]
        weight = float(light[numbers].std(axis=0).mean())
        total += (
            weight
            * (float((shown * seen).sum()) - float(np.mean(chance)))
            / max(float(np.std(chance)), 1e-12)
        )
        weights += weight**2
    return float(total / np.sqrt(weights)) if weights else None


def compared(program: Program, looks: Mapping[int, Doubles]) -> int:
    """The number of patterns that `score` compares."""
    return sum(map(len, _parts(program, looks)))


def odd_patterns(program: Program, light: Light, looks: Mapping[int, Doubles]) -> list[int]:
    """The patterns that look unlike others of their kind: something was in front, or the program is another one.

    These are random patterns too far from the mean of their part, and constant ones that look darker than most of the
    darker ones.
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
    """For each random part, the numbers of the patterns seen, if there are enough of them."""
    for start, part in zip(program.starts, program.parts, strict=False):
        numbers = [number for number in range(start, start + part.count) if number in looks]
        if isinstance(part, Bernoulli) and len(numbers) >= MIN_PATTERNS:
            yield numbers


def _products(pictures: Doubles) -> Doubles:
    """Inner products of n pictures, (n, ..., channels), centred and normalised, in each channel.

    Returns
    -------
    (channels, n, n) float64
        Zero on the diagonals.
    """
    count, channels = len(pictures), pictures.shape[-1]
    each = np.moveaxis(pictures - pictures.mean(axis=0), -1, 0).reshape(channels, count, -1)
    each /= np.maximum(np.linalg.norm(each, axis=2, keepdims=True), 1e-12)
    products: Doubles = each @ each.transpose(0, 2, 1)
    products[:, np.arange(count), np.arange(count)] = 0
    return products
