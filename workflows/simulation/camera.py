"""A pinhole camera in front of an object and a monitor: rays through its pixels, and where their light comes from.

An object fits into a sphere of radius 1 about the origin. The camera is `CAMERA` in front of the origin and looks along
+z at it and at the centre of the monitor, which is perpendicular to the axis and `MONITOR` behind. x increases with the
columns and y with the rows, both of frames and of the monitor, so the monitor is upright when seen directly.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from storage.errors import OptionError
from workflows.simulation.optics import Doubles, Ends, uniform
from workflows.simulation.scene import Floats, Scene, Transport

CAMERA = 5.0
"""Distance from the pinhole to the object's centre."""
MONITOR = 3.0
"""Distance from the object's centre to the monitor."""
OBJECT_SHARE = 0.85
"""The width of the sphere around the object in a frame, as a share of the frame's shorter side."""
MONITOR_MARGIN = 1.5
"""The monitor's size as a multiple of the camera's field of view in its plane, so that light refracted by up to about
45 degrees reaches it."""
BATCH_RAYS = 1 << 16
"""Rays traced at once: about 30 MB of arrays."""

Room = Callable[[Doubles], Doubles]
"""The light of the room that comes against directions (3, n), as shares (n,) of the monitor's white."""
Hits = tuple[NDArray[np.bool_], Ends]


class Through(Protocol):
    """Traces rays with directions (3, n) from the camera through an object of glass; returns which hit it, and how they
    leave it. Those that miss it are not among the ends."""

    def __call__(self, ray: Doubles, index: float, absorption: float) -> Hits: ...


class Traced(NamedTuple):
    """What the camera sees in one channel."""

    transport: Transport
    coverage: Floats
    reflections: Floats


@dataclass(frozen=True)
class Camera:
    """Rays through the pixels of a camera, and where they end on the monitor.

    Attributes
    ----------
    width, height : int
        The camera's pixels.
    monitor : (int, int)
        The monitor's pixels.
    rays : int
        Rays per camera pixel, a square number: one at a random position in each cell of a square grid.
    seed : int
        Seed of the rays' positions.
    distance : float
        Distance from the object's centre to the monitor. The monitor's size does not depend on it.

    Raises
    ------
    OptionError
        If ``rays`` is not a square number.
    """

    width: int
    height: int
    monitor: tuple[int, int]
    rays: int
    seed: int = 0
    distance: float = MONITOR

    def __post_init__(self) -> None:
        if self.rays < 1 or self._side**2 != self.rays:
            raise OptionError(f"rays must be a square number, not {self.rays}", field="rays")

    def film(
        self,
        through: Through,
        index: float | tuple[float, float, float],
        absorption: float | tuple[float, float, float],
        room: Room | None = None,
    ) -> Scene:
        """Trace an object whose glass has a refractive index and an absorption for red, green and blue.

        Identical channels are traced once. Without a room no light comes but the monitor's.
        """
        indices = index if isinstance(index, tuple) else (index,) * 3
        absorptions = absorption if isinstance(absorption, tuple) else (absorption,) * 3
        glasses = list(zip(indices, absorptions, strict=True))
        of_glass = {
            glass: self.trace(partial(through, index=glass[0], absorption=glass[1]), room)
            for glass in dict.fromkeys(glasses)
        }
        red, green, blue = (of_glass[glass] for glass in glasses)
        return Scene(
            self.width,
            self.height,
            self.monitor,
            (red.transport, green.transport, blue.transport),
            red.coverage,
            np.stack([red.reflections, green.reflections, blue.reflections], axis=2) if room else None,
        )

    def trace(self, through: Callable[[Doubles], Hits], room: Room | None = None) -> Traced:
        """Trace one channel."""
        pixels, rays = self.width * self.height, self.rays
        step = max(BATCH_RAYS // rays, 1)
        random = np.random.PCG64(self.seed)
        parts, coverage, reflections = [], np.empty(pixels, np.float32), np.zeros(pixels, np.float32)
        for first in range(0, pixels, step):
            pixel = np.arange(first, min(first + step, pixels)).repeat(rays)
            ray = self._rays(pixel, random)
            hit, ends = through(ray)
            coverage[first : first + step] = hit.reshape(-1, rays).mean(axis=1)
            origin = np.array([[0.0], [0.0], [-CAMERA]])
            direct = (np.flatnonzero(~hit), origin, ray[:, ~hit], np.ones(len(hit) - np.count_nonzero(hit)))
            entries = []
            for number, point, direction, weight in (direct, *ends):
                lit, target = self._targets(point, direction, weight)
                entries.append((number[lit], target, weight[lit]))
                if room:
                    seen = weight[~lit] * room(direction[:, ~lit])
                    arrived = np.bincount(number[~lit] // rays, seen, len(pixel) // rays)
                    reflections[first : first + step] += (arrived / rays).astype(np.float32)
            source, target, weight = (np.concatenate(column) for column in zip(*entries, strict=True))
            places = ((source // rays).astype(np.int32), target.astype(np.int32))
            shape = (len(pixel) // rays, self.monitor[0] * self.monitor[1])
            parts.append(sp.coo_array(((weight / rays).astype(np.float32), places), shape=shape).tocsr())
        frame = self.height, self.width
        return Traced(sp.vstack(parts, format="csr"), coverage.reshape(frame), reflections.reshape(frame))

    @property
    def seen(self) -> tuple[float, float]:
        """The monitor's width and height as multiples of the frame's, as the camera sees it directly."""
        across, down = self.half_monitor / (self.half_frame * (CAMERA + self.distance))
        return float(across), float(down)

    @cached_property
    def half_frame(self) -> Doubles:
        """(2,) float64: tangents of half the fields of view, across and down."""
        silhouette = 1 / math.sqrt(CAMERA**2 - 1)
        size = np.array([self.width, self.height], np.float64)
        return silhouette / OBJECT_SHARE * size / min(self.width, self.height)

    @cached_property
    def half_monitor(self) -> Doubles:
        """(2,) float64: half the monitor's size; its pixels are square."""
        pixels = np.array(self.monitor, np.float64)
        pitch = float(np.max(self.half_frame * (CAMERA + MONITOR) * MONITOR_MARGIN / pixels))
        return pixels * pitch

    @property
    def _side(self) -> int:
        """Cells along each axis of a pixel."""
        return math.isqrt(max(self.rays, 0))

    def _rays(self, pixel: NDArray[np.intp], random: np.random.PCG64) -> Doubles:
        """Unit directions (3, n) of rays through pixels, one per cell of a pixel."""
        side = self._side
        jitter = uniform(random, 2 * len(pixel))
        cell = np.arange(len(pixel)) % side**2
        across = pixel % self.width + (cell % side + jitter[::2]) / side
        down = pixel // self.width + (cell // side + jitter[1::2]) / side
        x = (2 * across / self.width - 1) * self.half_frame[0]
        y = (2 * down / self.height - 1) * self.half_frame[1]
        directions: Doubles = np.stack([x, y, np.ones_like(x)]) / np.sqrt(x * x + y * y + 1)
        return directions

    def _targets(
        self, point: Doubles, direction: Doubles, weight: Doubles
    ) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Which rays from points (3, n) hit the monitor, and the pixels that these hit."""
        steps = (self.distance - point[2]) / np.where(direction[2] > 0, direction[2], np.nan)
        x = (point[0] + steps * direction[0]) / self.half_monitor[0]
        y = (point[1] + steps * direction[1]) / self.half_monitor[1]
        hit = (np.abs(x) < 1) & (np.abs(y) < 1) & (weight > 0)
        width, height = self.monitor
        column = np.minimum((x[hit] + 1) / 2 * width, width - 1).astype(np.intp)
        row = np.minimum((y[hit] + 1) / 2 * height, height - 1).astype(np.intp)
        return hit, row * width + column
