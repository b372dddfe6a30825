"""Conversion of lobes to weights of nodes, and back by the moments of these weights."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import NODES, PatternCodes, fit_level, sample, signed_codes
from workflows.recovery.lobes.mixture import Mixture
from workflows.recovery.pyramid import Grids

# Nodes with a smaller share of T are dropped: the rims of lobes have many. From 2e-5 to 5e-5 this gains 0.05 dB and a
# tenth of the time, 2e-4 costs 0.1 dB.
_LEAST_WEIGHT = 3e-5


@njit(nogil=True, cache=True)
def spread_lobes(
    grids: Grids,
    mixture: Mixture,
    k: int,
    resolution: float,
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
    end: NDArray[np.int64],
) -> int:
    """Write the nodes under k lobes and their weights, which sum to 1.

    Parameters
    ----------
    grids : Grids
    mixture : Mixture
        Changed in place: lobes are moved to the levels for this resolution.
    k : int
        Number of lobes.
    resolution : float
        As in :func:`~workflows.recovery.lobes.footprint.fit_level`.
    node, weight : (k NODES,) int64, float32
        Written, lobe after lobe; a node under two lobes occurs twice.
    end : (k or more,) int64
        Written: where the nodes of each lobe end.

    Returns
    -------
    int
        The number of nodes.
    """
    lobes, level = mixture.lobes, mixture.level
    terms, n, total = np.empty((1, NODES), np.float32), 0, 0.0
    for i in range(k):
        total += lobes[i, 0]
    for i in range(k):
        level[i] = fit_level(lobes[i], level[i], grids.columns, resolution)
        found = sample(lobes[i], level[i], grids, node[n:], terms)
        for j in range(found):
            weight[n + j] = terms[0, j] * lobes[i, 0] / total
        n += found
        end[i] = n
    return n


@njit(nogil=True, cache=True)
def merge_nodes(
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
    end: NDArray[np.int64],
    k: int,
    seen: NDArray[np.int32],
) -> int:
    """Leave each node to the first of the lobes that it is under, with the sum of its weights; drop those of little.

    Parameters
    ----------
    node, weight, end
        As from :func:`spread_lobes`; changed in place.
    k : int
        Number of lobes.
    seen : (nodes,) int32
        Zeros, one for each node of the pyramid, and again afterwards.

    Returns
    -------
    int
        The number of nodes left.

    Notes
    -----
    But for what is dropped the posterior mean of T is the same: a node that is there twice has one row of A, and the
    variances of its prior add up as the weights do.
    """
    n, begin = 0, 0
    for i in range(k):
        for j in range(begin, end[i]):
            at = seen[node[j]]
            if at > 0:
                weight[at - 1] += weight[j]
            else:
                node[n], weight[n] = node[j], weight[j]
                n += 1
                seen[node[n - 1]] = n
        begin, end[i] = end[i], n
    n, begin = 0, 0
    for i in range(k):
        for j in range(begin, end[i]):
            seen[node[j]] = 0
            if weight[j] >= _LEAST_WEIGHT:
                node[n], weight[n] = node[j], weight[j]
                n += 1
        begin, end[i] = end[i], n
    return n


@njit(nogil=True, cache=True)
def gather_lobes(
    grids: Grids,
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
    end: NDArray[np.int64],
    mixture: Mixture,
    k: int,
    resolution: float,
) -> None:
    """Give k lobes the moments of the weights of their nodes: the inverse of :func:`spread_lobes`.

    Parameters
    ----------
    grids : Grids
    node, weight, end
        As from :func:`spread_lobes`, with any weights.
    mixture : Mixture
        Changed in place. A lobe with a total weight of almost 0 keeps its centre and shape.
    k : int
        Number of lobes.
    resolution : float
        As in :func:`~workflows.recovery.lobes.footprint.fit_level`.
    """
    columns, starts, level = grids.columns, grids.starts, mixture.level
    begin = 0
    for i in range(k):
        spacing, lobe = 2.0 ** level[i], mixture.lobes[i]
        total, sx, sy, sxx, sxy, syy = 1e-30, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(begin, end[i]):
            row, column = divmod(node[j] - starts[level[i]], columns[level[i]])
            # relative to the lobe's centre, to avoid cancellation
            w, x, y = weight[j], (column + 0.5) * spacing - lobe[1], (row + 0.5) * spacing - lobe[2]
            total += w
            sx, sy = sx + w * x, sy + w * y
            sxx, sxy, syy = sxx + w * x * x, sxy + w * x * y, syy + w * y * y
        begin = end[i]
        lobe[0] = total
        if total > 1e-6:
            x, y = sx / total, sy / total
            least = (0.3 * spacing) ** 2
            lobe[1], lobe[2] = lobe[1] + x, lobe[2] + y
            lobe[3] = math.sqrt(max(sxx / total - x * x, least))
            lobe[4] = (sxy / total - x * y) / lobe[3]
            lobe[5] = math.sqrt(max(syy / total - y * y - lobe[4] ** 2, least))
            level[i] = fit_level(lobe, level[i], columns, resolution)


@njit(nogil=True, cache=True)
def node_responses(patterns: PatternCodes, node: NDArray[np.int64], n: int, A: NDArray[np.float32]) -> None:
    """Write the response of each node: the measurements of a pixel if all light came from that node.

    Parameters
    ----------
    patterns : PatternCodes
    node : (n or more,) int64
    n : int
        Number of nodes.
    A : (n or more, groups (m + 2)) float32
        Written.
    """
    m = patterns.m
    for g in range(patterns.groups):
        to = g * (m + 2)
        signed_codes(patterns.code, patterns.first + g * m, m, node, n, A, to)
        for i in range(n):
            A[i, to + m], A[i, to + m + 1] = -1.0, 1.0
