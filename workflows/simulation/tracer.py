"""Traces solids of glass in front of a monitor, with exact light transport."""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.simulation.camera import CAMERA, Camera, Hits, Room
from workflows.simulation.optics import Doubles, Ends, fresnel
from workflows.simulation.scene import Scene
from workflows.simulation.solids import Solid

LEAST = 2e-3
"""Weight below which a ray is given up; its light is lost."""


class Bundle(NamedTuple):
    """Rays: their numbers (m,), points (3, m), directions (3, m) and weights (m,)."""

    number: NDArray[np.intp]
    point: Doubles
    direction: Doubles
    weight: Doubles

    def part(self, wanted: NDArray[np.bool_]) -> "Bundle":
        """Some of the rays."""
        return Bundle(
            self.number[wanted], self.point[:, wanted], self.direction[:, wanted], self.weight[wanted]
        )


def trace(
    solid: Solid,
    camera: Camera,
    *,
    index: float | tuple[float, float, float] = 1.5,
    absorption: float | tuple[float, float, float] = 0.0,
    surfaces: int = 8,
    room: Room | None = None,
) -> Scene:
    """Trace a solid in front of a monitor.

    Parameters
    ----------
    solid : Solid
        Within a distance of 1 from the origin.
    camera : Camera
    index : float or three
        Refractive index for red, green and blue.
    absorption : float or three
        Absorption of red, green and blue per unit of length: the share exp(-absorption s) is left after a length s
        (Beer-Lambert).
    surfaces : int
        Most surfaces that a ray is followed through.
    room : callable, optional
        The light of the room; without it no light comes but the monitor's.

    Returns
    -------
    Scene

    Notes
    -----
    Rays are traced backwards from the camera. At each surface one becomes two, weighted by Fresnel's equations.
    """
    return camera.film(partial(through, solid=solid, surfaces=surfaces), index, absorption, room)


def through(ray: Doubles, index: float, absorption: float, solid: Solid, surfaces: int) -> Hits:
    """Trace rays with directions (3, n) from the camera through a solid, see `workflows.simulation.camera.Through`."""
    rays = ray.shape[1]
    start = solid.turn.T @ np.array([[0.0], [0.0], [-CAMERA]])
    outside = Bundle(
        np.arange(rays), np.broadcast_to(start, (3, rays)), solid.turn.T @ ray, np.ones(rays, np.float64)
    )
    inside = outside.part(np.zeros(rays, np.bool_))
    hit = np.zeros(rays, np.bool_)
    ends: Ends = []
    for surface in range(surfaces + 1):
        distance, normal = solid.enter(outside.point, outside.direction)
        met = np.isfinite(distance)
        if surface:
            gone = outside.part(~met)
            ends.append((gone.number, solid.turn @ gone.point, solid.turn @ gone.direction, gone.weight))
        else:
            hit = met
        if surface == surfaces:
            break
        reflected, entered = _split(outside.part(met), distance[met], normal[:, met], index)
        distance, normal = solid.leave(inside.point, inside.direction)
        dimmed = inside._replace(weight=inside.weight * np.exp(-absorption * distance))
        kept, left = _split(dimmed, distance, normal, 1 / index)
        outside, inside = _together(reflected, left), _together(entered, kept)
    return hit, ends


def _split(rays: Bundle, distance: Doubles, normal: Doubles, index: float) -> tuple[Bundle, Bundle]:
    """The reflected and the refracted rays at a surface.

    Parameters
    ----------
    rays : Bundle
    distance : (m,) float64
        From the rays' points to the surface.
    normal : (3, m) float64
        Unit normals there, of either sign.
    index : float
        Ratio of the refractive indices behind and in front of the surface.
    """
    cosine = -(rays.direction * normal).sum(axis=0)
    normal = np.where(cosine < 0, -normal, normal)
    cosine = np.abs(cosine)
    reflectance, refracted = fresnel(cosine, index)
    point = rays.point + distance * rays.direction
    back = rays.direction + 2 * cosine * normal
    on = rays.direction / index + (cosine / index - refracted) * normal
    return (
        Bundle(rays.number, point, back, rays.weight * reflectance),
        Bundle(rays.number, point, on, rays.weight * (1 - reflectance)),
    )


def _together(*bundles: Bundle) -> Bundle:
    """Rays of several bundles that are worth following."""
    kept = [bundle.part(bundle.weight > LEAST) for bundle in bundles]
    return Bundle(*(np.concatenate(column, axis=-1) for column in zip(*kept, strict=True)))
