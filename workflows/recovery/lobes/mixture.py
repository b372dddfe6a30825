"""T as a mixture of oriented Gaussian lobes, and the measurements that it predicts.

The measurements y of a pixel are in groups: one for each channel that T is fitted to, or one for the mean of channels
that saw the same patterns. A group is its m patterns in +-1 form, a black monitor and a white one. The model is
``y = sum_s a_s B_s + sum_k w_k D_k``, D_k the response of lobe k alone and B_s stray light. The weights w_k need not
sum to 1, since the black and the white monitor constrain the sum. Each group has its own amounts a_s of stray light.
The first, of constant light, is free.

Where glass disperses, the lobes of red and blue lie on opposite sides of those of green. One vector d says how far: it
is that of blue's, and red's is a fixed part of it.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import (
    NODES,
    PARAMETERS,
    PatternCodes,
    combine,
    parts_of,
    sample,
)
from workflows.recovery.lobes.strays import write_strays

RATES = (-0.65, 0.0, 1.0)
"""How far the lobes of red, green and blue lie from green's, in units of the dispersion. Recovered glass has -0.58 to
-0.68 for red."""


class Mixture(NamedTuple):
    """Up to n lobes of a T, and stray light.

    Attributes
    ----------
    lobes : (n, 6) float64
        Parameters as in :mod:`~workflows.recovery.lobes.footprint`.
    level : (n,) int64
        The level that each lobe is sampled on.
    stray : (groups s or more,) float64
        The amounts of each group's stray light.
    dispersion : (2,) float64
        How far blue's lobes lie from green's along x and y, in cells of the first grid; 0 but in a fit that disperses.
    """

    lobes: NDArray[np.float64]
    level: NDArray[np.int64]
    stray: NDArray[np.float64]
    dispersion: NDArray[np.float64]


class Workspace(NamedTuple):
    """Working space of :func:`predict`; t is 6 for derivatives, or 1.

    Attributes
    ----------
    node : (NODES,) int64
    terms : (t, NODES) float32
    lobe : (6,) float64
    sums : (t, groups m or more) float32
    """

    node: NDArray[np.int64]
    terms: NDArray[np.float32]
    lobe: NDArray[np.float64]
    sums: NDArray[np.float32]


@njit(nogil=True, cache=True, inline="always")
def make_workspace(light: int) -> Workspace:
    """Make working space with derivatives, for up to `light` patterns in all groups."""
    return Workspace(
        np.empty(NODES, np.int64),
        np.empty((PARAMETERS, NODES), np.float32),
        np.empty(PARAMETERS),
        np.empty((PARAMETERS, light), np.float32),
    )


@njit(nogil=True, cache=True, inline="always")
def without_derivatives(workspace: Workspace) -> Workspace:
    """The same working space, for predictions alone."""
    return Workspace(workspace.node, workspace.terms[:1], workspace.lobe, workspace.sums[:1])


@njit(nogil=True, cache=True, inline="always")
def move(lobe: NDArray[np.float64], dispersion: NDArray[np.float64], channel: int) -> None:
    """Move a lobe of green to where a channel has it."""
    lobe[1] += RATES[channel] * dispersion[0]
    lobe[2] += RATES[channel] * dispersion[1]


@njit(nogil=True, cache=True)
def predict(
    patterns: PatternCodes,
    mixture: Mixture,
    k: int,
    workspace: Workspace,
    response: NDArray[np.float32],
    f: NDArray[np.float32],
) -> None:
    """Predict the measurements of a pixel.

    Parameters
    ----------
    patterns : PatternCodes
    mixture : Mixture
    k : int
        Number of lobes.
    workspace : Workspace
    response : (k or more, t or more, groups (m + 2)) float32
        Written: D_k of each lobe, and its derivatives.
    f : (groups (m + 2),) float32
        Written: the prediction.
    """
    node, terms, lobe, sums = workspace
    # Once, not for each lobe: what is taken out of a tuple is counted as a reference.
    grids, code, lobes, level = patterns.grids, patterns.code, mixture.lobes, mixture.level
    m = patterns.m
    parts, groups = parts_of(patterns)
    write_strays(patterns.strays, mixture.stray, 0, f)
    for i in range(k):
        for part in range(parts):
            for t in range(PARAMETERS):
                lobe[t] = lobes[i, t]
            if patterns.dispersed:
                move(lobe, mixture.dispersion, part)
            n = sample(lobe, level[i], grids, node, terms)
            combine(code, patterns.first + part * groups * m, groups * m, node, n, terms, sums)
            for t in range(terms.shape[0]):
                for g in range(groups):
                    to = (part * groups + g) * (m + 2)
                    for j in range(m):
                        response[i, t, to + j] = sums[t, g * m + j]
                    response[i, t, to + m] = -1.0 if t == 0 else 0.0
                    response[i, t, to + m + 1] = 1.0 if t == 0 else 0.0
        weight = np.float32(lobes[i, 0])
        for j in range(f.size):
            f[j] += weight * response[i, 0, j]


@njit(nogil=True, cache=True)
def copy_mixture(k: int, strays: int, mixture: Mixture, to: Mixture) -> None:
    """Copy the first k lobes, the first amounts of stray light and the dispersion."""
    # loops compile faster than slices
    for i in range(k):
        to.level[i] = mixture.level[i]
        for t in range(PARAMETERS):
            to.lobes[i, t] = mixture.lobes[i, t]
    for s in range(strays):
        to.stray[s] = mixture.stray[s]
    to.dispersion[0], to.dispersion[1] = mixture.dispersion[0], mixture.dispersion[1]


@njit(nogil=True, cache=True)
def clone(mixture: Mixture) -> Mixture:
    """A mixture with arrays of its own."""
    return Mixture(
        mixture.lobes.copy(), mixture.level.copy(), mixture.stray.copy(), mixture.dispersion.copy()
    )
