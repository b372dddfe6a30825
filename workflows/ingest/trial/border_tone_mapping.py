"""Measure how much a camera brightens what is dark around a place, by the border of a film, whose light is known."""

from typing import NamedTuple

import numpy as np

from workflows.ingest.camera.border_exposure import BorderLight, Doubles
from workflows.ingest.light.local_gain import DARK, DISPLAY, Surroundings

SWEEPS = 8
"""Sweeps over what is free in each value, and then in each frame."""


class Power(NamedTuple):
    """The power of local tone mapping, its standard error, and how much of the residuals it explains."""

    power: float
    error: float
    explained: float


def border_power(border: BorderLight, near: Surroundings) -> Power:
    """The power of local tone mapping that a film's border shows.

    Parameters
    ----------
    border : BorderLight
    near : Surroundings
        Logarithms of the brightness around each place.

    Notes
    -----
    The border is lit by the bits of the pattern's number, whatever the patterns show beside it. Where it is lit, light
    C becomes larger by ``-p log(m) C``, m the brightness around the place. Patterns beside it also spread light onto
    it, in lit and dark places alike: an unknown share of the light around is fitted too, or glare would hide the power.
    Each value's amounts of the bits, and each frame's gain and veil, are left free.
    """
    around = near.at(*border.places).astype(np.float64)
    variance = (border.rest**2).mean(axis=0)
    weight = border.usable / np.maximum(variance, max(float(np.median(variance)), 1e-20))
    mapped, spread, left = (
        _without_free(values, border, weight)
        for values in (-border.own * around, (np.exp(around) - DARK) ** (1 / DISPLAY), border.rest)
    )
    columns = np.stack([mapped, spread])
    products = np.einsum("ifn,jfn,fn->ij", columns, columns, weight)
    inverse = np.linalg.pinv(products)
    if inverse[0, 0] <= 0:  # the surroundings never change
        return Power(0.0, np.inf, 0.0)
    found = inverse @ np.einsum("ifn,fn,fn->i", columns, left, weight)
    left = left - np.tensordot(found, columns, 1)
    # The values of a frame are not independent.
    pull = np.einsum("ifn,fn,fn->if", columns, left, weight)
    error = float(np.sqrt(((inverse @ pull)[0] ** 2).sum()))
    power = float(found[0])
    return Power(power, error, float(power**2 / inverse[0, 0]) if power > 0 else 0.0)


def _without_free(values: Doubles, border: BorderLight, weight: Doubles) -> Doubles:
    """Values without what is free in each of them, and in each frame."""
    inverse = np.linalg.pinv(border.design)
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-20)

    def centred(v: Doubles) -> Doubles:
        mean: Doubles = (weight * v).sum(axis=1, keepdims=True) / total
        return v - mean

    lit = centred(border.own)
    size = np.maximum((weight * lit**2).sum(axis=1, keepdims=True), 1e-20)
    values = np.where(border.usable, values, 0)
    for _ in range(SWEEPS):
        values = centred(values - border.design @ (inverse @ values))
        values = values - (weight * lit * values).sum(axis=1, keepdims=True) / size * lit
        values = np.where(border.usable, values, 0)
    return values
