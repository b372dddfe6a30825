"""The sensing matrices as they arrive through veiling glare."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from workflows.recovery.glare import Spread
from workflows.recovery.sensing import Level, Sensing


def filter_sensing(
    sensing: Sensing, parts: Sequence[Spread], shares: Sequence[float], width: int, height: int
) -> Sensing:
    """The patterns as they arrive through glare, on each level: what a T without glare would have to see.

    Parameters
    ----------
    sensing : Sensing
    parts : sequence of Spread
        As from :func:`~workflows.recovery.glare.spread_patterns`, of the same patterns.
    shares : sequence of float
        As from :func:`~workflows.recovery.glare.fit_shares`.
    width, height : int
        The grid over the monitor in whose cells `parts` count.

    Returns
    -------
    Sensing

    Notes
    -----
    The light L of a cell, 0 to 1, becomes ``(1 - sum g) L + sum_k g_k (B_k + 1) / 2``. B_k, from -1 to 1, is taken at
    the cell's centre: the Gaussians are wide, and where cells are wider, patterns are constant on most of a cell.
    """
    return Sensing(tuple(_filter_level(level, parts, shares, width, height) for level in sensing.levels))


def _filter_level(
    level: Level, parts: Sequence[Spread], shares: Sequence[float], width: int, height: int
) -> Level:
    light = np.float32(1 - sum(shares)) * level.light
    x = (np.arange(level.columns) + 0.5) * width / level.columns
    for row in range(level.rows):
        cells = slice(row * level.columns, (row + 1) * level.columns)
        y = np.full(level.columns, (row + 0.5) * height / level.rows)
        for part, share in zip(parts, shares, strict=True):
            if share > 0:
                arrived = part.at(x, y).reshape(level.columns, len(light), -1)[..., level.patterns]
                light[:, cells] += np.float32(share / 2) * (arrived.transpose(1, 0, 2) + 1)
    return replace(level, light=light)
