"""Solids of glass with exact surfaces: convex bodies of planes and ellipsoids, one of which may be hollowed out.

Rays are points (3, n) and directions (3, n) of length 1.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from workflows.simulation.optics import Doubles

TOUCHING = 1e-9
"""A surface nearer than this is the one that a ray starts from."""


@dataclass(frozen=True, eq=False)
class Convex:
    """The points p with ``normals @ p <= offsets`` that are inside of all ellipsoids.

    Attributes
    ----------
    normals : (planes, 3) float64
        Unit vectors, outward.
    offsets : (planes,) float64
    centres, axes : (ellipsoids, 3) float64
        The ellipsoids' centres and half axes, which are parallel to x, y and z.
    """

    normals: Doubles = field(default_factory=lambda: np.empty((0, 3)))
    offsets: Doubles = field(default_factory=lambda: np.empty(0))
    centres: Doubles = field(default_factory=lambda: np.empty((0, 3)))
    axes: Doubles = field(default_factory=lambda: np.empty((0, 3)))

    def span(
        self, point: Doubles, direction: Doubles
    ) -> tuple[Doubles, NDArray[np.intp], Doubles, NDArray[np.intp]]:
        """Find where the lines of rays are inside.

        Returns
        -------
        near : (n,) float64
        front : (n,) intp
            The distance at which a line comes in, and the surface there: a plane or, after these, an ellipsoid.
        far : (n,) float64
        back : (n,) intp
            The same of where it goes out. Lines that miss the body have ``near >= far``.
        """
        rays = direction.shape[1]
        near, far = np.full(rays, -np.inf), np.full(rays, np.inf)
        front, back = np.zeros(rays, np.intp), np.zeros(rays, np.intp)

        def narrow(surface: int, first: Doubles, last: Doubles) -> None:
            np.copyto(front, surface, where=first > near)
            np.maximum(near, first, out=near)
            np.copyto(back, surface, where=last < far)
            np.minimum(far, last, out=far)

        with np.errstate(divide="ignore", invalid="ignore"):
            for surface, (normal, offset) in enumerate(zip(self.normals, self.offsets, strict=True)):
                slope, room = normal @ direction, offset - normal @ point
                at = room / slope
                outside = (slope == 0) & (room < 0)
                narrow(
                    surface,
                    np.where(slope < 0, at, np.where(outside, np.inf, -np.inf)),
                    np.where(slope > 0, at, np.inf),
                )
        for surface, (centre, axes) in enumerate(
            zip(self.centres, self.axes, strict=True), len(self.offsets)
        ):
            along, start = direction / axes[:, None], (point - centre[:, None]) / axes[:, None]
            a, b = (along * along).sum(axis=0), (along * start).sum(axis=0)
            discriminant = b * b - a * ((start * start).sum(axis=0) - 1)
            root = np.sqrt(np.maximum(discriminant, 0))
            misses = discriminant <= 0
            narrow(
                surface, np.where(misses, np.inf, (-b - root) / a), np.where(misses, -np.inf, (root - b) / a)
            )
        return near, front, far, back

    def normal(self, surface: NDArray[np.intp], point: Doubles) -> Doubles:
        """Outward unit normals (3, n) of surfaces at points of them."""
        normals = np.empty_like(point)
        planes = len(self.offsets)
        flat = surface < planes
        normals[:, flat] = self.normals[surface[flat]].T
        for number, (centre, axes) in enumerate(zip(self.centres, self.axes, strict=True), planes):
            on = surface == number
            gradient = (point[:, on] - centre[:, None]) / (axes * axes)[:, None]
            normals[:, on] = gradient / np.sqrt((gradient * gradient).sum(axis=0))
        return normals


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body, less a convex cavity if it has one.

    Attributes
    ----------
    body : Convex
    cavity : Convex, optional
    turn : (3, 3) float64
        Rotation from the axes of the body to those of the camera.
    """

    body: Convex
    cavity: Convex | None = None
    turn: Doubles = field(default_factory=lambda: np.eye(3))

    def enter(self, point: Doubles, direction: Doubles) -> tuple[Doubles, Doubles]:
        """Find where rays outside of the glass meet it first.

        Returns
        -------
        distance : (n,) float64
            Infinite for rays that do not meet it.
        normal : (3, n) float64
            Unit normals there, of either sign.
        """
        near, front, far, _ = self.body.span(point, direction)
        outer = (near < far) & (near > TOUCHING)
        if self.cavity is None:
            distance = np.where(outer, near, np.inf)
            return distance, self.body.normal(front, _at(point, distance, direction))
        hollow, _, filled, back = self.cavity.span(point, direction)
        outer &= ~((hollow < near) & (near < filled))  # else it comes in through the mouth of the cavity
        inner = (hollow < filled) & (filled > TOUCHING) & (near < filled) & (filled < far)
        first = np.where(outer, near, np.inf)
        distance = np.minimum(first, np.where(inner, filled, np.inf))
        return distance, self._normal(distance == first, front, back, _at(point, distance, direction))

    def leave(self, point: Doubles, direction: Doubles) -> tuple[Doubles, Doubles]:
        """The same for rays in the glass, where they meet its surface. All of them do."""
        _, _, far, back = self.body.span(point, direction)
        distance = np.maximum(far, 0)  # rounding may put a point a little outside of an edge
        if self.cavity is None:
            return distance, self.body.normal(back, _at(point, distance, direction))
        hollow, front, filled, _ = self.cavity.span(point, direction)
        inner = (hollow < filled) & (hollow > TOUCHING) & (hollow < far)
        distance = np.where(inner, hollow, distance)
        return distance, self._normal(~inner, back, front, _at(point, distance, direction))

    def _normal(
        self, outer: NDArray[np.bool_], body: NDArray[np.intp], cavity: NDArray[np.intp], point: Doubles
    ) -> Doubles:
        """Normals of the body's surfaces where `outer`, else of the cavity's."""
        assert self.cavity is not None
        return np.where(outer, self.body.normal(body, point), self.cavity.normal(cavity, point))


def _at(point: Doubles, distance: Doubles, direction: Doubles) -> Doubles:
    """Points on rays; where a distance is infinite, the ray's start."""
    reached: Doubles = point + np.where(np.isfinite(distance), distance, 0) * direction
    return reached


def turned(*turns: tuple[str, float]) -> Doubles:
    """A rotation by degrees about the axes x, y and z, one after another.

    Examples
    --------
    >>> turned(("z", 90)) @ [1, 0, 0]
    array([6.123234e-17, 1.000000e+00, 0.000000e+00])
    """
    rotation = np.eye(3)
    for axis, degrees in turns:
        cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        one = np.eye(3)
        one[[i, i, j, j], [i, j, i, j]] = cosine, -sine, sine, cosine
        rotation = one @ rotation
    return rotation
