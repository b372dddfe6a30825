"""The measurements of pixels, and the fits of lobes to them: one to all channels, or one to each."""

from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.lobes.footprint import NODES, PARAMETERS, PatternCodes
from workflows.recovery.lobes.mixture import Mixture
from workflows.recovery.lobes.nodes import merge_nodes, node_responses, spread_lobes
from workflows.recovery.normalise import Measurements
from workflows.recovery.pyramid import Grids

ALL, DISPERSED = np.int64(3), np.int64(4)
"""A pixel has up to five fits: 0 to 2 are those of its channels, these are of all channels together, the second with
their lobes apart. For Python's own integers numba compiles each kernel once more for each constant that it is given."""


class Pixels(NamedTuple):
    """The measurements of n pixels, and their patterns.

    Attributes
    ----------
    grids : Grids
    code : (nodes, channels m) uint8
        Light of the m patterns on the nodes of the pyramid; 1 or 3 channels.
    joint : Measurements
        Measurements of all channels together, (n, channels (m + 2)).
    own : Measurements
        Measurements of each channel, (n, 3, m + 2).
    strays : (s, m + 2) float32
        As in :class:`~workflows.recovery.lobes.footprint.PatternCodes`.
    """

    grids: Grids
    code: NDArray[np.uint8]
    joint: Measurements
    own: Measurements
    strays: NDArray[np.float32]


class Fits(NamedTuple):
    """The fits of each of n pixels.

    Attributes
    ----------
    lobes : (n, 5, most, 6) float64
    level : (n, 5, most) int64
    stray : (n, 5, 3 s) float64
    dispersion : (n, 5, 2) float64
        As in :class:`~workflows.recovery.lobes.mixture.Mixture`.
    k : (n, 5) int64
        Number of lobes of each fit; 0 where there is no fit.
    objective : (n, 5) float64
        -2 ln likelihood.
    rest : (n, 5) float64
        Mean squared residual of the patterns.
    """

    lobes: NDArray[np.float64]
    level: NDArray[np.int64]
    stray: NDArray[np.float64]
    dispersion: NDArray[np.float64]
    k: NDArray[np.int64]
    objective: NDArray[np.float64]
    rest: NDArray[np.float64]

    @classmethod
    def of(cls, pixels: int, most: int, strays: int) -> Self:
        """No fits yet, of up to `most` lobes and with `strays` kinds of stray light."""
        return cls(
            np.zeros((pixels, 5, most, PARAMETERS)),
            np.zeros((pixels, 5, most), np.int64),
            np.zeros((pixels, 5, 3 * strays)),
            np.zeros((pixels, 5, 2)),
            np.zeros((pixels, 5), np.int64),
            np.zeros((pixels, 5)),
            np.zeros((pixels, 5)),
        )


@njit(nogil=True, cache=True, inline="always")
def fit_of(fits: Fits, p: int, c: int) -> Mixture:
    """Fit c of pixel p."""
    return Mixture(fits.lobes[p, c], fits.level[p, c], fits.stray[p, c], fits.dispersion[p, c])


@njit(nogil=True, cache=True, inline="always")
def fits_of_transport(separate: bool) -> range:
    """The fits that T is made of: one for each channel if these are separate, or one for all."""
    return range(0 if separate else ALL, ALL if separate else ALL + 1)


class NodeBuffers(NamedTuple):
    """Working space for the nodes under all lobes of a fit.

    Attributes
    ----------
    node : (most NODES,) int64
    weight : (most NODES,) float32
    end : (most,) int64
        As from :func:`~workflows.recovery.lobes.nodes.spread_lobes`.
    seen : (nodes,) int32
        As in :func:`~workflows.recovery.lobes.nodes.merge_nodes`.
    rows : (most NODES channels (m + 2),) float32
    """

    node: NDArray[np.int64]
    weight: NDArray[np.float32]
    end: NDArray[np.int64]
    seen: NDArray[np.int32]
    rows: NDArray[np.float32]


@njit(nogil=True, cache=True)
def make_buffers(most: int, size: int, nodes: int) -> NodeBuffers:
    """Make working space for up to `most` lobes of a pixel of `size` measurements, on a pyramid of so many nodes."""
    return NodeBuffers(
        np.empty(most * NODES, np.int64),
        np.empty(most * NODES, np.float32),
        np.empty(most, np.int64),
        np.zeros(nodes, np.int32),
        np.empty(most * NODES * size, np.float32),
    )


@njit(nogil=True, cache=True, inline="always")
def spread_to(
    buffers: NodeBuffers, patterns: PatternCodes, mixture: Mixture, k: int, resolution: float, merged: bool
) -> NDArray[np.float32]:
    """Write the nodes under k lobes, which are moved to the levels for this resolution; return their responses.

    If `merged`, a node under several lobes is there only once, and nodes of little weight are not. The moments of each
    lobe are then not to be had from its nodes.
    """
    node, weight, end = buffers.node, buffers.weight, buffers.end
    n = spread_lobes(patterns.grids, mixture, k, resolution, node, weight, end)
    if merged:
        n = merge_nodes(node, weight, end, k, buffers.seen)
    size = patterns.groups * (patterns.m + 2)
    A = buffers.rows[: n * size].reshape(n, size)
    node_responses(patterns, node, n, A)
    return A


@njit(nogil=True, cache=True)
def measurements_of(
    pixels: Pixels, p: int, c: int
) -> tuple[PatternCodes, NDArray[np.float32], NDArray[np.float32]]:
    """The patterns, measurements and variances for fit c of pixel p."""
    grids, code, joint, own, _ = pixels
    m = own.value.shape[2] - 2
    groups = code.shape[1] // m
    if c >= ALL:
        patterns = PatternCodes(grids, code, 0, groups, m, pixels.strays, c == DISPERSED)
        return patterns, joint.value[p], joint.variance[p]
    first = c * m if groups == 3 else 0
    return PatternCodes(grids, code, first, 1, m, pixels.strays, False), own.value[p, c], own.variance[p, c]
