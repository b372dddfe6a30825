"""Scores of nodes: how much better light from there would explain what is left of a pixel's measurements."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import PatternCodes
from workflows.recovery.lobes.mixture import RATES


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract"})
def score(
    code: NDArray[np.uint8],
    nodes: NDArray[np.int64],
    first: int,
    f: NDArray[np.float32],
    residual: NDArray[np.float32],
    precision: NDArray[np.float32],
) -> tuple[float, float]:
    """Score a node: the gain of moving light to it from the prediction.

    Parameters
    ----------
    code : (nodes, first + groups m or more) uint8
    nodes : (parts,) int64
        The node that each part of the groups sees, as from :func:`see`.
    first : int
        The column of `code` with the first pattern.
    f, residual, precision : (groups m,) float32
        As from :func:`in_codes`.

    Returns
    -------
    z : float
        Score in standard deviations.
    amount : float
        Light to move, as a share.

    Notes
    -----
    ``z = sum d r / v / sqrt(sum d^2 / v)``, d the node's row less the prediction, r the residual and v its variance.
    """
    along, across = np.float32(0), np.float32(1e-9)
    size = f.size // nodes.size
    for part in range(nodes.size):
        # An unsigned index can't count from the end, so the loop has no branches; slices would be counted references.
        node, start = np.uint64(nodes[part]), np.uint64(part * size)
        row = start + np.uint64(first)
        for j in range(size):
            at = start + np.uint64(j)
            d = np.float32(code[node, row + np.uint64(j)]) - f[at]
            along += d * residual[at]
            across += d * d * precision[at]
    return float(along / math.sqrt(across)), float(along / across)


@njit(nogil=True, cache=True, inline="always")
def see(
    grid: tuple[int, int, int],
    column: int,
    row: int,
    dispersion: tuple[float, float],
    nodes: NDArray[np.int64],
) -> None:
    """Write the node that each part of the groups sees.

    Parameters
    ----------
    grid : (int, int, int)
        Columns, rows and the first node of a grid.
    column, row : int
        The node that green sees.
    dispersion : (float, float)
        In spacings of the grid.
    nodes : (parts,) int64
        Written. A single part sees the same as green.
    """
    wide, high, start = grid
    if nodes.size == 1:
        nodes[0] = start + row * wide + column
        return
    for part in range(nodes.size):
        c = column + int(np.rint(RATES[part] * dispersion[0]))
        r = row + int(np.rint(RATES[part] * dispersion[1]))
        nodes[part] = start + min(max(r, 0), high - 1) * wide + min(max(c, 0), wide - 1)


@njit(nogil=True, cache=True)
def in_codes(
    patterns: PatternCodes, y: NDArray[np.float32], f: NDArray[np.float32], precision: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Convert to units of the patterns' codes: prediction, residual times precision, and precision, (groups m,)."""
    groups, m = patterns.groups, patterns.m
    code_of_f, residual = np.empty(groups * m, np.float32), np.empty(groups * m, np.float32)
    weight = np.empty(groups * m, np.float32)
    unit = np.float32(2 / 255)
    for g in range(groups):
        for j in range(m):
            at = g * (m + 2) + j
            code_of_f[g * m + j] = (f[at] + 1) / unit
            residual[g * m + j] = unit * (y[at] - f[at]) * precision[at]
            weight[g * m + j] = unit**2 * precision[at]
    return code_of_f, residual, weight


@njit(nogil=True, cache=True)
def insert(
    z: float,
    node: tuple[int, int, int, int],
    scores: NDArray[np.float64],
    nodes: NDArray[np.int64],
    count: int,
) -> int:
    """Insert a node into a list in descending order of scores, which drops its last if full; return the new length."""
    if count == scores.size and not z > scores[count - 1]:
        return count
    at = min(count, scores.size - 1)
    length = at + 1
    while at > 0 and scores[at - 1] < z:
        scores[at] = scores[at - 1]
        for i in range(4):
            nodes[at, i] = nodes[at - 1, i]
        at -= 1
    scores[at] = z
    nodes[at, 0], nodes[at, 1], nodes[at, 2], nodes[at, 3] = node
    return length
