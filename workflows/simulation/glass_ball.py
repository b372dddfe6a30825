"""A ray-traced glass ball in front of a monitor, with exact light transport: test data without a camera.

The ball has radius 1 and its centre is the origin. A pinhole camera `CAMERA` radii in front of it looks along +z at
the centres of the ball and of the monitor, which is perpendicular to the axis and `MONITOR` radii behind. x increases
with the columns and y with the rows, both of frames and of the monitor, so the monitor is upright when seen directly.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from storage.errors import OptionError
from workflows.simulation.scene import Floats, Scene, Transport

CAMERA = 5.0
"""Distance from the pinhole to the ball's centre, in radii of the ball."""
MONITOR = 3.0
"""Distance from the ball's centre to the monitor, in radii: beyond the focus, so the image is inverted."""
BALL_SHARE = 0.85
"""The ball's width in a frame, as a share of the frame's shorter side."""
MONITOR_MARGIN = 1.5
"""The monitor's size as a multiple of the camera's field of view in its plane, so that light refracted by up to about
45 degrees reaches it."""
BATCH_RAYS = 1 << 16
"""Rays traced at once: about 30 MB of arrays."""

Doubles = NDArray[np.float64]
Ends = list[tuple[NDArray[np.intp], Doubles, Doubles, Doubles]]


def fresnel(cosine: Doubles, index: float) -> tuple[Doubles, Doubles]:
    """Compute reflection and refraction of unpolarised light at a surface.

    Parameters
    ----------
    cosine : (...) float64
        Cosine of the angle between the incident ray and the normal, above 0.
    index : float
        Ratio of the refractive indices behind and in front of the surface.

    Returns
    -------
    reflectance : (...) float64
        Share of the power reflected; 1 under total reflection. The rest is refracted.
    refracted : (...) float64
        Cosine of the refracted ray's angle to the normal; 0 under total reflection.

    References
    ----------
    M. Born and E. Wolf, Principles of Optics, 7th ed., 1999, Sect. 1.5: Snell's law (1.5.1), Fresnel's
    formulae (1.5.2), natural light as the mean of both polarisations (1.5.3), total reflection (1.5.4).
    """
    refracted = np.sqrt(np.maximum(1 - (1 - cosine**2) / index**2, 0))
    perpendicular = (cosine - index * refracted) / (cosine + index * refracted)
    parallel = (index * cosine - refracted) / (index * cosine + refracted)
    return (perpendicular**2 + parallel**2) / 2, refracted


def glass_ball(
    width: int = 160,
    height: int = 120,
    *,
    monitor: tuple[int, int] = (1280, 960),
    rays: int = 64,
    index: float | tuple[float, float, float] = 1.5,
    absorption: float | tuple[float, float, float] = 0.0,
    bounces: int = 4,
    seed: int = 0,
    distance: float = MONITOR,
) -> Scene:
    """Trace a glass ball in front of a monitor.

    Parameters
    ----------
    width, height : int
        The camera's pixels.
    monitor : (int, int)
        The monitor's width and height in pixels.
    rays : int
        Rays per camera pixel, a square number: one at a random position in each cell of a square grid.
    index : float or three
        Refractive index for red, green and blue; below 1 for a bubble.
    absorption : float or three
        Absorption of red, green and blue per radius of the ball: the share exp(-absorption s) is left after a length s
        (Beer-Lambert).
    bounces : int
        Number of internal reflections that are followed.
    seed : int
        Seed of the rays' positions; the same seed gives the same scene.
    distance : float
        Distance from the ball's centre to the monitor, in radii. The monitor's size does not depend on it.

    Returns
    -------
    Scene

    Raises
    ------
    OptionError
        If ``rays`` is not a square number.

    Notes
    -----
    Rays are traced backwards from the camera. At each surface a ray's weight is split by Fresnel's equations, not at
    random. Rays that are reflected by the ball's outside, or that leave it without hitting the monitor, carry no light,
    so rho < 1 there.
    """
    side = math.isqrt(rays)
    if rays < 1 or side * side != rays:
        raise OptionError(f"rays must be a square number, not {rays}", field="rays")
    indices = index if isinstance(index, tuple) else (index,) * 3
    absorptions = absorption if isinstance(absorption, tuple) else (absorption,) * 3
    glasses = list(zip(indices, absorptions, strict=True))
    camera = _Camera(width, height, monitor, side, seed, distance)
    traced = {glass: camera.trace(*glass, bounces) for glass in dict.fromkeys(glasses)}
    red, green, blue = (traced[glass][0] for glass in glasses)
    return Scene(width, height, monitor, (red, green, blue), traced[glasses[0]][1])


@dataclass(frozen=True)
class _Camera:
    """Rays through the pixels of a camera, and where they end on the monitor."""

    width: int
    height: int
    monitor: tuple[int, int]
    side: int
    seed: int
    distance: float

    def trace(self, index: float, absorption: float, bounces: int) -> tuple[Transport, Floats]:
        """Trace a ball; return its transport and coverage."""
        pixels, rays = self.width * self.height, self.side**2
        step = max(BATCH_RAYS // rays, 1)
        random = np.random.PCG64(self.seed)
        parts, coverage = [], np.empty(pixels, np.float32)
        for first in range(0, pixels, step):
            pixel = np.arange(first, min(first + step, pixels)).repeat(rays)
            ray = self._rays(pixel, random)
            hit, ends = _through_ball(ray, index, absorption, bounces)
            coverage[first : first + step] = hit.reshape(-1, rays).mean(axis=1)
            origin = np.array([[0.0], [0.0], [-CAMERA]])
            direct = (np.flatnonzero(~hit), origin, ray[:, ~hit], np.ones(len(hit) - np.count_nonzero(hit)))
            entries = [self._deposit(*end) for end in (direct, *ends)]
            source, target, weight = (np.concatenate(column) for column in zip(*entries, strict=True))
            places = ((source // rays).astype(np.int32), target.astype(np.int32))
            shape = (len(pixel) // rays, self.monitor[0] * self.monitor[1])
            parts.append(sp.coo_array(((weight / rays).astype(np.float32), places), shape=shape).tocsr())
        return sp.vstack(parts, format="csr"), coverage.reshape(self.height, self.width)

    @cached_property
    def half_frame(self) -> Doubles:
        """(2,) float64: tangents of half the fields of view, across and down."""
        silhouette = 1 / math.sqrt(CAMERA**2 - 1)
        size = np.array([self.width, self.height], np.float64)
        return silhouette / BALL_SHARE * size / min(self.width, self.height)

    @cached_property
    def half_monitor(self) -> Doubles:
        """(2,) float64: half the monitor's size in radii; its pixels are square."""
        pixels = np.array(self.monitor, np.float64)
        pitch = float(np.max(self.half_frame * (CAMERA + MONITOR) * MONITOR_MARGIN / pixels))
        return pixels * pitch

    def _rays(self, pixel: NDArray[np.intp], random: np.random.PCG64) -> Doubles:
        """Unit directions (3, n) of rays through pixels, one per cell of a pixel."""
        jitter = _uniform(random, 2 * len(pixel))
        cell = np.arange(len(pixel)) % self.side**2
        across = pixel % self.width + (cell % self.side + jitter[::2]) / self.side
        down = pixel // self.width + (cell // self.side + jitter[1::2]) / self.side
        x = (2 * across / self.width - 1) * self.half_frame[0]
        y = (2 * down / self.height - 1) * self.half_frame[1]
        directions: Doubles = np.stack([x, y, np.ones_like(x)]) / np.sqrt(x * x + y * y + 1)
        return directions

    def _deposit(
        self, ray: NDArray[np.intp], point: Doubles, direction: Doubles, weight: Doubles
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Doubles]:
        """Find the rays from points (3, n) that hit the monitor; return them, the pixels hit, and their weights."""
        steps = (self.distance - point[2]) / np.where(direction[2] > 0, direction[2], np.nan)
        x = (point[0] + steps * direction[0]) / self.half_monitor[0]
        y = (point[1] + steps * direction[1]) / self.half_monitor[1]
        hit = (np.abs(x) < 1) & (np.abs(y) < 1) & (weight > 0)
        width, height = self.monitor
        column = np.minimum((x[hit] + 1) / 2 * width, width - 1).astype(np.intp)
        row = np.minimum((y[hit] + 1) / 2 * height, height - 1).astype(np.intp)
        return ray[hit], row * width + column, weight[hit]


def _through_ball(
    ray: Doubles, index: float, absorption: float, bounces: int
) -> tuple[NDArray[np.bool_], Ends]:
    """Trace rays with directions (3, n) from the camera through the ball.

    Returns
    -------
    hit : (n,) bool
        Which rays hit the ball.
    ends : list of (ray (m,) intp, point (3, m), direction (3, m), weight (m,))
        The rays that leave the ball after 0, 1, ... internal reflections: index, position, direction and weight.

    Notes
    -----
    In a ball all chords of a path have the same length and the same angles to the surface. So the reflectance R is the
    same everywhere (also from both sides, Born and Wolf, Sect. 1.5.3). The share (1 - R)^2 R^k leaves after k internal
    reflections; these and the share R reflected outside sum to 1. A ray that has entered is never totally reflected.
    """
    middle = CAMERA * ray[2]
    discriminant = middle**2 - (CAMERA**2 - 1)
    hit = discriminant > 0
    cosine, direction = np.sqrt(discriminant[hit]), ray[:, hit]
    point = (middle[hit] - cosine) * direction
    point[2] -= CAMERA
    # The radius is 1, so the normal at a point is the point itself; `cosine` is that of the incident angle.
    reflectance, inner = fresnel(cosine, index)
    direction = direction / index + (cosine / index - inner) * point
    left = np.exp(-2 * absorption * inner)
    weight = (1 - reflectance) ** 2 * left
    ends: Ends = []
    for _ in range(bounces + 1):
        point = point + 2 * inner * direction
        ends.append(
            (np.flatnonzero(hit), point, index * direction + (cosine - index * inner) * point, weight)
        )
        direction = direction - 2 * inner * point
        weight = weight * reflectance * left
    return hit, ends


def _uniform(random: np.random.PCG64, count: int) -> Doubles:
    """Doubles from 0 to 1, from the top 53 bits of raw words: unlike Generator's, the same in all versions of numpy."""
    return np.asarray((random.random_raw(count) >> np.uint64(11)) * 2.0**-53, np.float64)


def backdrop(width: int = 1280, height: int = 960, seed: int = 0) -> Floats:
    """Make a backdrop to judge composites by: a rotated checkerboard with white seams and smoothly varying colours.

    Parameters
    ----------
    width, height : int
        Size in pixels.
    seed : int
        Seed of the colours.

    Returns
    -------
    (height, width, 3) float32
        Linear light, 0 to 1.
    """
    y, x = np.mgrid[:height, :width] / height
    rotated = np.stack([0.966 * x + 0.259 * y, 0.966 * y - 0.259 * x]) * 22
    wave = np.sin(np.pi * rotated)
    # Edges are about a pixel wide and not parallel to the blocks of patterns.
    dark = np.clip(0.5 + wave[0] * wave[1] * height / 80, 0, 1)[..., None]
    seam = np.clip(1.6 - np.abs(wave).min(axis=0) * height / 80, 0, 1)[..., None]
    phase = _uniform(np.random.PCG64(seed), 3)
    across, down = np.array([0.7, 0.9, 0.6]), np.array([0.5, -0.6, 0.8])
    colour = 0.5 + 0.42 * np.sin(2 * np.pi * (x[..., None] * across + y[..., None] * down + phase))
    tiles = colour * (1 - dark) + 0.3 * (1 - colour) * dark
    return np.asarray(tiles + (0.95 - tiles) * seam, np.float32)
