"""A ray-traced glass ball in front of a monitor, with exact light transport: test data without a camera.

The ball has radius 1 and its centre is the origin of :mod:`workflows.simulation.camera`. The monitor is beyond the
focus, so the image is inverted.
"""

from functools import partial

import numpy as np

from workflows.simulation.camera import CAMERA, MONITOR, Camera, Hits
from workflows.simulation.optics import Doubles, Ends, fresnel, uniform
from workflows.simulation.scene import Floats, Scene


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
    camera = Camera(width, height, monitor, rays, seed, distance)
    return camera.film(partial(_through_ball, bounces=bounces), index, absorption)


def _through_ball(ray: Doubles, index: float, absorption: float, bounces: int) -> Hits:
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
    phase = uniform(np.random.PCG64(seed), 3)
    across, down = np.array([0.7, 0.9, 0.6]), np.array([0.5, -0.6, 0.8])
    colour = 0.5 + 0.42 * np.sin(2 * np.pi * (x[..., None] * across + y[..., None] * down + phase))
    tiles = colour * (1 - dark) + 0.3 * (1 - colour) * dark
    return np.asarray(tiles + (0.95 - tiles) * seam, np.float32)
