"""Gaussian stripes and a gradient of colours: the two methods of Chuang et al. 2000."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from tests.benchmarks.field.methods.method import (
    Film,
    Floats,
    Matte,
    Program,
    channels,
    normalised,
    scaled,
    sparse_rows,
    with_constants,
)

Doubles = NDArray[np.float64]

WIDTH = 2.0
"""Standard deviation of a stripe, in the monitor's pixels."""
STEP = 2.0
"""Pixels from a stripe to the next."""
MOST = 4
"""Lobes of a pixel and channel."""
DIRECTIONS = np.array([[1, 0], [0, 1], [0.5**0.5, 0.5**0.5], [0.5**0.5, -(0.5**0.5)]])
"""Across the stripes: vertical ones, horizontal ones, and both diagonals."""


class Swept:
    """Y.-Y. Chuang, D. Zongker, J. Hindorff, B. Curless, D. Salesin and R. Szeliski, "Environment matting extensions:
    towards higher accuracy and real-time capture", SIGGRAPH 2000, Sect. 3.

    A Gaussian stripe is swept over the monitor, vertical, horizontal and along both diagonals. Each channel of a pixel
    is a sum of oriented Gaussians, fitted to all frames by Levenberg-Marquardt. Both are the publication's. Left open
    or chosen here: stripes of 2 pixels' deviation in steps of 2; the start, peaks of the vertical and the horizontal
    sweep paired as all four sweeps allow, with weights by non-negative least squares; at most four lobes, as many as
    lie above the noise; one fit for all channels where the glass has no colour.
    """

    name = "Chuang 2000, swept stripes"

    def program(self, columns: int, rows: int) -> Program:
        y, x = np.mgrid[:rows, :columns] + 0.5
        corners = np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]])
        self.at, self.direction = [], []
        stripes = []
        for direction in DIRECTIONS:
            along = corners @ direction
            across = direction[0] * x + direction[1] * y
            for at in np.arange(along.min(), along.max() + STEP, STEP):
                stripes.append(
                    np.round(255 * np.exp(-((across - at) ** 2) / (2 * WIDTH**2))).astype(np.uint8)
                )
                self.at.append(at)
            self.direction.append(len(self.at))
        yield with_constants(np.stack(stripes)[..., None])

    def recover(self, film: Film) -> Matte:
        still, rho, shares = normalised(film)
        columns, rows = film.size
        at = np.split(np.array(self.at), self.direction[:-1])
        T = [
            sparse_rows(
                (
                    _drawn(_fit(value, at, one), columns, rows)
                    for value, one in zip(values, sigma, strict=True)
                ),
                columns * rows,
            )
            for values, sigma in channels(shares, rho, film.noise)
        ]
        return scaled(still, rho, T)


def _fit(value: Floats, at: list[Doubles], noise: float) -> Doubles:
    """Lobes (k, 6) of a pixel's values (m,) under the sweeps: weight, centre, and the covariance's Cholesky factor."""
    sweeps = np.split(value.astype(np.float64), np.cumsum([one.size for one in at])[:-1])
    start = _start(sweeps, at, noise)

    def error(flat: Doubles) -> Doubles:
        return _light(flat.reshape(-1, 6), at)[0] - value

    def slope(flat: Doubles) -> Doubles:
        return _light(flat.reshape(-1, 6), at)[1]

    fitted = least_squares(error, start.ravel(), slope, method="lm", max_nfev=40).x.reshape(-1, 6)
    if not np.isfinite(fitted).all():
        fitted = start
    fitted[:, 0] = nnls(_each(fitted, at), value)[0]  # two lobes may have met, one of them below 0
    return fitted


def _each(lobes: Doubles, at: list[Doubles]) -> Doubles:
    """What the sweeps show of each lobe alone with a weight of 1, (m, k)."""
    return np.stack([_light(np.append(1, lobe[1:])[None], at)[0] for lobe in lobes], axis=1)


def _start(sweeps: list[Doubles], at: list[Doubles], noise: float) -> Doubles:
    """Peaks of the vertical and of the horizontal sweep, paired where the diagonals allow."""
    from scipy.signal import find_peaks  # takes long to import, and collecting tests does not need it

    places, widths = [], []
    for sweep, where in zip(sweeps[:2], at[:2], strict=True):
        least = max(4 * noise, 0.05 * sweep.max())
        peaks, _ = find_peaks(np.concatenate([[0], sweep, [0]]), height=least, prominence=least / 2)
        peaks = peaks - 1 if peaks.size else np.array([sweep.argmax()])
        peaks = peaks[np.argsort(-sweep[peaks])][: 2 * MOST]
        area = STEP * np.maximum(sweep, 0).sum() / max(sweep[peaks].sum(), 1e-6)
        places.append(where[peaks])
        widths.append(max(area**2 / (2 * np.pi) - WIDTH**2, 0.25) ** 0.5)
    x, y = (axis.ravel() for axis in np.meshgrid(*places))
    lobes = np.zeros((x.size, 6))
    lobes[:, 1], lobes[:, 2] = x, y
    lobes[:, 3], lobes[:, 5] = np.minimum(widths, 20)
    lobes[:, 0] = nnls(_each(lobes, at), np.concatenate(sweeps))[0]
    best = lobes[np.argsort(-lobes[:, 0])][:MOST]
    return best[best[:, 0] >= min(0.02, best[0, 0])]


def _light(lobes: Doubles, at: list[Doubles]) -> tuple[Doubles, Doubles]:
    """What the sweeps of stripes show of lobes (k, 6): values (m,), and their derivatives (m, 6 k).

    A stripe's light is the Gaussian of both variances along its direction, as high as the stripe's share of it.
    """
    w, cx, cy, a, b, c = lobes.T[:, :, None]
    values, slopes = [], []
    for (dx, dy), where in zip(DIRECTIONS, at, strict=True):
        # Sigma = L L' with L = [[a, 0], [b, c]]; L' d = (a dx + b dy, c dy).
        first, second = a * dx + b * dy, c * dy
        s2 = WIDTH**2 + first**2 + second**2
        away = where - (dx * cx + dy * cy)
        unit = WIDTH / np.sqrt(s2) * np.exp(-(away**2) / (2 * s2))
        value = w * unit
        by_s2 = value * (away**2 / s2 - 1) / (2 * s2)
        by_centre = value * away / s2
        parts = [
            unit,
            by_centre * dx,
            by_centre * dy,
            by_s2 * 2 * first * dx,
            by_s2 * 2 * first * dy,
            by_s2 * 2 * second * dy,
        ]
        values.append(value.sum(axis=0))
        slopes.append(np.stack(parts, axis=1).reshape(-1, where.size).T)
    return np.concatenate(values), np.concatenate(slopes)


def _drawn(lobes: Doubles, columns: int, rows: int) -> tuple[NDArray[np.intp], Floats]:
    """The pixels of lobes, and their weights."""
    places, weights = [np.zeros(0, np.intp)], [np.zeros(0)]
    for w, cx, cy, a, b, c in lobes:
        covariance = np.array([[a * a, a * b], [a * b, b * b + c * c]]) + np.eye(2) / 12
        centre, reach = np.array([cx, cy]), np.ceil(3.5 * np.sqrt(np.diag(covariance)))
        left, top = np.maximum(np.floor(centre - reach), 0).astype(int)
        right, bottom = np.minimum(np.ceil(centre + reach), [columns, rows]).astype(int)
        if right <= left or bottom <= top:
            continue
        y, x = np.mgrid[top:bottom, left:right]
        away = np.stack([x.ravel() + 0.5 - cx, y.ravel() + 0.5 - cy])
        density = np.exp(-(away * np.linalg.solve(covariance, away)).sum(axis=0) / 2)
        inside = (centre - reach >= 0).all() and (centre + reach <= [columns, rows]).all()
        # What lies beyond the monitor gives no light.
        total = density.sum() if inside else 2 * np.pi * np.sqrt(np.linalg.det(covariance))
        if total > 0:
            places.append((y * columns + x).ravel())
            weights.append(w * density / total)
    return np.concatenate(places), np.concatenate(weights)


class OneFrame:
    """The same publication's Sect. 4: one frame before a gradient of colours, for video.

    The colours are a plane through the cube of RGB, so that a frame's three values tell the place, u and v, and rho.
    The glass must be colourless and clear, a pixel sees one place, and the room is dark: the publication's own
    assumptions. Left open or chosen here: the plane, ``(u, v, 1 - (u + v) / 2)``; the camera's black level is known,
    0.02; the highlights, which the publication finds by their brightness, are none here; the matte is not smoothed.
    """

    name = "Chuang 2000, one frame"
    BLACK = 0.02

    def program(self, columns: int, rows: int) -> Program:
        y, x = np.mgrid[:rows, :columns] + 0.5
        u, v = x / columns, y / rows
        yield np.round(255 * np.stack([u, v, 1 - (u + v) / 2], axis=2)).astype(np.uint8)[None]

    def recover(self, film: Film) -> Matte:
        columns, rows = film.size
        light = film.values[:, 0] - np.float32(self.BLACK)
        rho = np.maximum(light @ np.array([0.5, 0.5, 1], np.float32), 1e-3)
        x, y = (
            np.clip(light[:, axis] / rho * size, 0, size - 1).astype(np.intp)
            for axis, size in ((0, columns), (1, rows))
        )
        T = sparse_rows(((np.array([at]), np.ones(1)) for at in y * columns + x), columns * rows)
        return scaled(np.full_like(light, self.BLACK), np.repeat(rho[:, None], 3, axis=1), [T])
