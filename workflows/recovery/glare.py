"""Veiling glare: light from all around the place that a pixel sees, scattered in the lens, in the room and in glass.

A share of each pixel's light comes from broad Gaussians about its place on the monitor, and from the whole monitor. The
shares are common to all pixels. They are far too small and too wide to be found as lobes of a single pixel, but lobes
that have to explain them are too wide or off their place.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.recovery.camera.noise import MEDIAN_TO_SIGMA
from workflows.recovery.pyramid import Grids, Pyramid, bump_variance, halve_codes
from workflows.recovery.sensing import Patterns
from workflows.recovery.transport import LEAST_WEIGHT, Transport

WIDTHS = (1 / 96, 1 / 32, 1 / 10)
"""Standard deviations of the Gaussians, as shares of the monitor's width. One more part is the whole monitor."""
LEAST = 0.01
"""Glare that takes a smaller share of the light is left out."""

# Standard deviations beyond which a residual gets less weight.
_HUBER = 1.5
# Rows of cells whose patterns are filtered at a time.
_ROWS = 8
# Nodes of a Gaussian are as far apart as it allows: its smallest standard deviation in their spacings.
_RESOLUTION = 0.8
# Squared Mahalanobis distance at which a Gaussian is cut off.
_REACH = 10.0


class Spread(NamedTuple):
    """The patterns' light, -1 (black) to 1 (white), as it arrives from about each place.

    Attributes
    ----------
    spacing : float
        Of the places, in cells of the pyramid's first grid.
    light : (rows, columns, channels m) float32
    """

    spacing: float
    light: NDArray[np.float32]

    def at(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.float32]:
        """The light at n places in cells of the first grid, (n, channels m) float32."""
        light = np.zeros((x.size, self.light.shape[2]), np.float32)
        _add_interpolated(self.light, self.spacing, x.astype(np.float64), y.astype(np.float64), 1.0, light)
        return light


def spread_patterns(patterns: Patterns) -> list[Spread]:
    """The light of the patterns as it arrives through each part of the glare: the Gaussians, then the whole monitor."""
    from scipy.ndimage import gaussian_filter  # takes long to import, and compositing does not need it

    pyramid, parts = patterns.pyramid, []
    for width in WIDTHS:
        sigma, level = width * pyramid.grids[0][0], 0
        while level < len(pyramid.grids) - 1 and 2 ** (level + 1) <= sigma / 2:
            level += 1
        light = _light_of(patterns, level)
        blur = np.sqrt(max(sigma**2 - bump_variance(level), 0.0)) / 2**level
        # Beside the monitor there is no light, and a white monitor is 1 everywhere.
        inside = gaussian_filter(np.ones(light.shape[:2], np.float32), blur, mode="constant")[..., np.newaxis]
        blurred = gaussian_filter(light, (blur, blur, 0), mode="constant")
        parts.append(Spread(2.0**level, (blurred / inside).astype(np.float32)))
    whole = patterns.code[whole_monitor(pyramid)].mean(axis=0, dtype=np.float32) / np.float32(127.5) - 1
    return [*parts, Spread(1.0, whole[np.newaxis, np.newaxis])]


def whole_monitor(pyramid: Pyramid) -> NDArray[np.int64]:
    """Nodes whose mean is about that of the monitor: every third of the coarsest grid, whose bumps overlap."""
    columns, rows = pyramid.grids[-1]
    across, down = np.arange(columns % 3 // 2, columns, 3), np.arange(rows % 3 // 2, rows, 3)
    nodes: NDArray[np.int64] = pyramid.starts[-2] + (down[:, np.newaxis] * columns + across).ravel()
    return nodes


def _light_of(patterns: Patterns, level: int) -> NDArray[np.float32]:
    columns, rows = patterns.pyramid.grids[level]
    code = patterns.code[slice(*patterns.pyramid.starts[level : level + 2])]
    light: NDArray[np.float32] = code.reshape(rows, columns, -1).astype(np.float32) / np.float32(127.5) - 1
    return light


def fit_shares(
    parts: NDArray[np.float32], residual: NDArray[np.float32], weight: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Fit the shares of the parts of the glare to what T leaves unexplained.

    Parameters
    ----------
    parts : (k, parts) float32
        Light that arrives through each part, less the light that T predicts.
    residual : (k,) float32
        Measurements less what T predicts.
    weight : (k,) float32
        Inverse variances.

    Returns
    -------
    (parts,) float64
        Zero or more.

    Notes
    -----
    ``y = (1 - sum g) T L + sum_k g_k B_k``, so the residual is ``sum_k g_k (B_k - T L)``: non-negative least squares,
    once more without the weight of outliers.
    """
    from scipy.optimize import nnls  # takes half a second to import, and compositing does not need it

    scale = np.sqrt(weight.astype(np.float64))
    shares = np.zeros(parts.shape[1])
    for _ in range(2):
        design, target = parts * scale[:, np.newaxis], residual * scale
        gram = design.T @ design
        root = np.linalg.cholesky(gram + 1e-9 * (np.trace(gram) + 1e-9) * np.eye(len(gram)))
        shares, _ = nnls(root.T, np.linalg.solve(root, design.T @ target))
        left = np.abs(residual - parts @ shares) * scale
        scale = scale * np.sqrt(
            np.minimum(1, _HUBER * MEDIAN_TO_SIGMA * np.median(left) / np.maximum(left, 1e-12))
        )
    return shares


def filter_patterns(patterns: Patterns, parts: Sequence[Spread], shares: Sequence[float]) -> Patterns:
    """The patterns as they arrive through glare: what a T without glare would have to see.

    Parameters
    ----------
    patterns : Patterns
    parts : sequence of Spread
        As from :func:`spread_patterns`.
    shares : sequence of float
        As from :func:`fit_shares`.
    """
    pyramid, code = patterns.pyramid, np.empty_like(patterns.code)
    columns, rows = pyramid.grids[0]
    own = 1 - sum(shares)
    x = np.tile(np.arange(columns) + 0.5, _ROWS)
    for first in range(0, rows, _ROWS):
        last = min(first + _ROWS, rows)
        cells = slice(first * columns, last * columns)
        light = np.float32(own) * (patterns.code[cells] / np.float32(127.5) - 1)
        y = np.repeat(np.arange(first, last) + 0.5, columns)
        for part, share in zip(parts, shares, strict=True):
            if share > 0:
                _add_interpolated(part.light, part.spacing, x[: y.size], y, share, light)
        code[cells] = np.clip((light + 1) * np.float32(127.5) + np.float32(0.5), 0, 255).astype(np.uint8)
    sums = np.empty(code.shape[1], np.uint16)
    for level in range(len(pyramid.grids) - 1):
        fine, coarse = (code[slice(*pyramid.starts[at : at + 2])] for at in (level, level + 1))
        halve_codes(fine, *pyramid.grids[level], coarse, sums)
    return replace(patterns, code=code)


@njit(nogil=True, cache=True)
def _add_interpolated(
    light: NDArray[np.float32],
    spacing: float,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    share: float,
    out: NDArray[np.float32],
) -> None:
    """Add a share of light, (rows, columns, m), to places, (n, m), by bilinear interpolation."""
    rows, columns, m = light.shape
    for i in range(x.size):
        u = min(max(x[i] / spacing - 0.5, 0.0), columns - 1.0)
        v = min(max(y[i] / spacing - 0.5, 0.0), rows - 1.0)
        left, top = int(u), int(v)
        right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
        s, t = u - left, v - top
        a, b = np.float32(share * (1 - s) * (1 - t)), np.float32(share * s * (1 - t))
        c, d = np.float32(share * (1 - s) * t), np.float32(share * s * t)
        p, q, r, w = light[top, left], light[top, right], light[bottom, left], light[bottom, right]
        of_place = out[i]
        for k in range(m):
            of_place[k] += a * p[k] + b * q[k] + c * r[k] + d * w[k]


def centres(pyramid: Pyramid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The centre of each node, x and y in cells of the first grid, (nodes,) float64 each."""
    x, y = [], []
    for level, (columns, rows) in enumerate(pyramid.grids):
        spacing = 2.0**level
        x.append(np.tile((np.arange(columns) + 0.5) * spacing, rows))
        y.append(np.repeat((np.arange(rows) + 0.5) * spacing, columns))
    return np.concatenate(x), np.concatenate(y)


def add_glare(transport: Transport, shares: Sequence[float], least_weight: float = LEAST_WEIGHT) -> Transport:
    """Add the glare to a T that was recovered from filtered patterns.

    Parameters
    ----------
    transport : Transport
    shares : sequence of float
        As from :func:`fit_shares`.
    least_weight : float
        Entries below this are dropped.

    Returns
    -------
    Transport
        With the Gaussians about the mean place of each row, as wide as the row itself and the Gaussian together, and
        the nodes that are the whole monitor.
    """
    columns, rows = transport.columns, transport.rows
    pyramid = Pyramid.over(columns, rows)
    x, y = centres(pyramid)
    sigma, whole = np.array([width * columns for width in WIDTHS]), whole_monitor(pyramid)
    entries = transport.count.ravel().astype(np.int64), transport.cell.astype(np.int64), transport.weight
    count, cell, weight = _add_to_rows(pyramid.arrays, x, y, *entries, sigma, whole, np.array(shares))
    return Transport.from_entries(
        columns, rows, count.reshape(transport.count.shape), cell, weight, transport.shared, least_weight
    )


@njit(nogil=True, cache=True)
def _add_to_rows(
    grids: Grids,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    count: NDArray[np.int64],
    node: NDArray[np.int64],
    weight: NDArray[np.float32],
    sigma: NDArray[np.float64],
    whole: NDArray[np.int64],
    shares: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """The entries of each row of T with those of its glare: counts of the rows, nodes and weights.

    `x` and `y`, (nodes,), are the centres of the pyramid's nodes, `sigma` the Gaussians' widths in cells, and `whole`
    the nodes that are the whole monitor.
    """
    columns, rows, starts = grids
    new_count, own = np.zeros_like(count), 1 - shares.sum()
    out, out_weight, end = np.empty(4 * node.size + 1, np.int64), np.empty(4 * node.size + 1, np.float32), 0
    begin = 0
    for row in range(count.size):
        if count[row] == 0:
            continue
        first, entries = end, range(begin, begin + count[row])
        begin += count[row]
        total, mx, my, vxx, vxy, vyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in entries:
            total, mx, my = total + weight[i], mx + weight[i] * x[node[i]], my + weight[i] * y[node[i]]
        mx, my = mx / max(total, 1e-12), my / max(total, 1e-12)
        for i in entries:
            w, dx, dy = weight[i] / max(total, 1e-12), x[node[i]] - mx, y[node[i]] - my
            vxx, vxy, vyy = vxx + w * dx * dx, vxy + w * dx * dy, vyy + w * dy * dy
        while end + count[row] + whole.size > out.size:
            out, out_weight = (
                np.append(out, np.empty_like(out)),
                np.append(out_weight, np.empty_like(out_weight)),
            )
        for i in entries:
            out[end], out_weight[end] = node[i], weight[i] * own
            end += 1
        for i in range(whole.size if shares[-1] > 0 else 0):
            out[end], out_weight[end] = whole[i], shares[-1] * total / whole.size
            end += 1
        for k in range(sigma.size):
            if shares[k] == 0:
                continue
            xx, xy, yy = vxx + sigma[k] ** 2, vxy, vyy + sigma[k] ** 2
            minor = math.sqrt((xx + yy) / 2 - math.hypot((xx - yy) / 2, xy))
            level = 0
            while level < columns.size - 1 and minor >= 2 * _RESOLUTION * 2.0**level:
                level += 1
            spacing = 2.0**level
            blur = bump_variance(level)
            xx, yy = max(xx - blur, 0.3 * spacing**2), max(yy - blur, 0.3 * spacing**2)
            area = max(xx * yy - xy**2, 0.01 * xx * yy)
            left = max(math.floor((mx - math.sqrt(_REACH * xx)) / spacing), 0)
            right = min(math.ceil((mx + math.sqrt(_REACH * xx)) / spacing), columns[level] - 1)
            top = max(math.floor((my - math.sqrt(_REACH * yy)) / spacing), 0)
            bottom = min(math.ceil((my + math.sqrt(_REACH * yy)) / spacing), rows[level] - 1)
            while end + (right - left + 1) * (bottom - top + 1) > out.size:
                out, out_weight = (
                    np.append(out, np.empty_like(out)),
                    np.append(out_weight, np.empty_like(out_weight)),
                )
            start, lit = end, 0.0
            for v in range(top, bottom + 1):
                for u in range(left, right + 1):
                    dx, dy = (u + 0.5) * spacing - mx, (v + 0.5) * spacing - my
                    far = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / area
                    if far < _REACH:
                        share = math.exp(-far / 2)
                        out[end], out_weight[end] = starts[level] + v * columns[level] + u, share
                        lit += share
                        end += 1
            for i in range(start, end):
                out_weight[i] *= shares[k] * total / lit
        new_count[row] = end - first
    return new_count, out[:end], out_weight[:end]
