"""Objects of glass to film, each within a distance of 1 from the origin, and a room that they mirror."""

import numpy as np

from workflows.simulation.optics import Doubles
from workflows.simulation.solids import Convex, Solid, turned


def lens(thickness: float = 0.3) -> Solid:
    """A lens of diameter 2 that is as thick in its middle, between two spheres; its axis is z."""
    radius = (1 + thickness**2 / 4) / thickness
    apart = radius - thickness / 2
    centres = np.array([[0.0, 0.0, -apart], [0.0, 0.0, apart]])
    return Solid(Convex(centres=centres, axes=np.full((2, 3), radius)))


def tumbler() -> Solid:
    """A tumbler with a thick foot: walls of ellipsoids, which narrow downwards, and a rounded bottom of the cavity.

    It is seen a little from above, so that its rim is an ellipse.
    """
    top, bottom = -0.73, 0.73
    rim = [0.0, top, 0.0]
    body = Convex(
        np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]),
        np.array([-top, bottom]),
        np.array([rim]),
        np.array([[0.68, 2.4, 0.68]]),
    )
    cavity = Convex(centres=np.array([rim, rim]), axes=np.array([[0.61, 2.3, 0.61], [1.05, 1.12, 1.05]]))
    return Solid(body, cavity, turned(("x", 14)))


def stone() -> Solid:
    """A round brilliant of 57 facets and a girdle, seen from the side and a little from above.

    References
    ----------
    M. Tolkowsky, Diamond Design, 1919, for the proportions: the table's width is 53 % of the girdle's, the crown's
    angle 34.5 degrees, the pavilion's 40.75. The smaller facets have the angles at which their edges meet.
    """
    table, girdle, crown, pavilion = 0.53, 0.02, np.radians(34.5), np.radians(40.75)
    step = 2 * np.pi / 16  # between the girdle's corners, of which every other belongs to a main facet
    height = girdle + (1 - table) * np.tan(crown)
    corner = np.cos(step / 2)  # share of the radius at which a side of the girdle is nearest
    normals, offsets = [np.array([0.0, 0.0, 1.0])], [height]

    def facets(first: float, count: int, angle: float, radius: float, level: float) -> None:
        """Facets around the axis, tilted by an angle from the horizontal, through a distance from the axis."""
        for turn in first + np.arange(count) * 2 * np.pi / count:
            up = np.copysign(np.cos(angle), level)
            normal = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), up])
            normals.append(normal)
            offsets.append(float(np.sin(angle) * radius + up * level))

    facets(0, 8, crown, 1, girdle)
    facets(step, 8, np.radians(20.5), table * np.cos(step), height)
    facets(step / 2, 16, np.radians(40.5), corner, girdle)
    facets(step / 2, 16, np.pi / 2, corner, girdle)
    facets(0, 8, pavilion, 1, -girdle)
    facets(step / 2, 16, np.radians(42.2), corner, -girdle)
    size = 0.96
    middle = np.array([0.0, 0.0, -0.2])
    shifted = size * (np.array(offsets) - np.array(normals) @ middle)
    return Solid(Convex(np.array(normals), shifted), turn=turned(("z", 8), ("x", 90), ("x", 24), ("z", -7)))


def window(direction: Doubles) -> Doubles:
    """The light of a dim room with a window of four panes, to the left, above and behind the camera.

    Parameters
    ----------
    direction : (3, n) float64
        Of rays towards the light.

    Returns
    -------
    (n,) float64
        Shares of the monitor's white.
    """
    towards = np.array([-0.55, -0.6, -0.58])
    towards /= np.linalg.norm(towards)
    across = np.cross(towards, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    ahead = np.maximum(towards @ direction, 1e-9)
    x, y = across @ direction / ahead, np.cross(across, towards) @ direction / ahead

    def within(low: float, high: float, value: Doubles) -> Doubles:
        """1 between two bounds, 0 beyond, and smooth between the two."""
        part: Doubles = np.clip((high - value) / (high - low), 0, 1)
        return part * part * (3 - 2 * part)

    panes = within(0.28, 0.34, np.abs(x)) * within(0.36, 0.42, np.abs(y))
    bars = np.maximum(within(0.02, 0.05, np.abs(x)), within(0.02, 0.05, np.abs(y)))
    wall: Doubles = 0.02 + 0.03 * np.clip(0.5 - direction[1] / 2, 0, 1)
    return wall + np.where(towards @ direction > 0.2, 0.9 * panes * (1 - bars), 0)
