"""A glass ball traced before a monitor, with its truth: a capture to try recovery on without a camera.

The ball has radius 1 and stands at the origin. A pinhole camera `CAMERA` radii before it looks along +z at
its centre and at that of the monitor, which is square to the axis and `MONITOR` radii behind it. x grows with
an image's columns and y with its rows, in frames and on the monitor alike: what is seen directly is upright.
"""

import json
import math
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Literal, TypedDict, Unpack

import imagecodecs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from storage.errors import OptionError
from workflows.program import Bernoulli, Constant, Monitor, Program, area_mean
from workflows.tone import from_light, to_light

CAMERA = 5.0
"""From the pinhole to the ball's centre, in radii of the ball."""
MONITOR = 3.0
"""From the ball's centre to the monitor, in radii: beyond the focus, so the ball shows it inverted."""
BALL_SHARE = 0.85
"""The ball's width in a frame, as a share of the frame's shorter side."""
MONITOR_MARGIN = 1.5
"""The monitor's size over what the camera sees of its plane: light bent by up to some 45 degrees finds it."""

BATCH_RAYS = 1 << 16
"""Rays traced at once: some 30 MB of arrays."""
BATCH_PATTERNS = 16
"""Patterns filmed at once."""
DEMO_BANDS = ((16, 12, 24), (32, 24, 24), (64, 48, 24), (128, 96, 26), (256, 192, 26))
"""Columns, rows and number of patterns of grids that nest, for a monitor of 1280 x 960 pixels."""

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Frame = NDArray[np.uint8] | NDArray[np.uint16]
Transport = sp.csr_array[np.float32, tuple[int, int]]
Transports = tuple[Transport, Transport, Transport]
Ends = list[tuple[NDArray[np.intp], Doubles, Doubles, Doubles]]


class FilmOptions(TypedDict, total=False):
    """The options of `Scene.film`."""

    offset: float
    gain: float
    noise: float
    depth: Literal[8, 16]
    response: Literal["linear", "srgb"]
    seed: int
    images: Sequence[Floats]


@dataclass(frozen=True, eq=False)
class Scene:
    """A transparent object before a monitor, and the light transport between monitor and camera.

    Attributes
    ----------
    width, height : int
        The camera's pixels.
    monitor : (int, int)
        The monitor's width and height in pixels.
    transport : three (height * width, monitor height * width) float32 CSR arrays
        rho T of red, green and blue: what each monitor pixel at full light adds to each camera pixel.
        Channels that are alike share one array.
    coverage : (height, width) float32
        The share of a camera pixel that the object covers, 0 to 1.
    """

    width: int
    height: int
    monitor: tuple[int, int]
    transport: Transports
    coverage: Floats

    @cached_property
    def rho(self) -> Floats:
        """(height, width, 3) float32: the share of an evenly lit monitor's light that arrives, 0 to 1."""
        return self.composite(np.ones((1, 1, 1), np.float32))

    @property
    def object_mask(self) -> NDArray[np.bool_]:
        """(height, width) bool: mostly object, and more than 5 % of the light arrives in every channel."""
        return (self.coverage > 0.5) & (self.rho > 0.05).all(axis=2)

    def composite(self, backdrop: Floats) -> Floats:
        """The light that arrives without noise, rho T L.

        Parameters
        ----------
        backdrop : (h, w, 3 or 1) float32
            Linear light at any size, stretched over the monitor.

        Returns
        -------
        (height, width, 3) float32
            Linear light.
        """
        shown = area_mean(backdrop, *self.monitor)
        arriving = self._arriving(self.transport, shown.reshape(1, -1, shown.shape[2]))
        return arriving.reshape(self.height, self.width, 3)

    def truth(self, backdrop: Floats, *, offset: float = 0.02, gain: float = 0.9) -> Floats:
        """What the sensor of `film` would see of a backdrop without noise, curve, clipping and rounding.

        Parameters
        ----------
        backdrop : (h, w, 3 or 1) float32
            Linear light at any size, stretched over the monitor.
        offset, gain : float
            As given to `film`.

        Returns
        -------
        (height, width, 3) float32
            Linear light, ``offset + gain * composite(backdrop)``.
        """
        return np.float32(offset) + np.float32(gain) * self.composite(backdrop)

    def film(
        self,
        program: Program,
        *,
        offset: float = 0.02,
        gain: float = 0.9,
        noise: float = 1.0,
        depth: Literal[8, 16] = 8,
        response: Literal["linear", "srgb"] = "linear",
        seed: int = 0,
        images: Sequence[Floats] = (),
    ) -> Iterator[Frame]:
        """Film a pattern program, one frame a pattern.

        Parameters
        ----------
        program : Program
            For a monitor of this scene's size. A monitor of ``unknown`` response is filmed as sRGB.
        offset, gain : float
            Ambient light, and the sensor's value for an evenly lit monitor seen directly, less that.
        noise : float
            1 is a sensor with a read noise of 0.002 of full scale and a shot noise of 0.006 at full scale.
        depth : {8, 16}
            Bits of a frame.
        response : {"linear", "srgb"}
            The camera's curve.
        seed : int
            Of the noise.
        images : sequence of (rows, columns, 1 or 3) float32
            Values sent to the monitor, 0 to 1, for the program's `Images` parts, in order.

        Returns
        -------
        iterator of (height, width, 3) uint8 or uint16
            In order of the patterns.

        Raises
        ------
        OptionError
            If the program is for a monitor of another size, or a number of images does not fit it.

        Notes
        -----
        With v = offset + gain * light and n normal of deviation noise * (0.002 + 0.006 sqrt(v)), a pixel
        stores curve(clip(v + n)), rounded.
        """
        if (program.monitor.width, program.monitor.height) != self.monitor:
            raise OptionError(
                "the program is for a monitor of another size than the scene's", field="program"
            )
        wanted = sum(part.count for part in program.parts if part.kind == "images")
        if len(images) != wanted:
            raise OptionError(f"the program shows {wanted} images, {len(images)} are given", field="images")
        rng = np.random.Generator(np.random.PCG64(seed))

        def frame(light: Floats) -> Frame:
            value = np.float32(offset) + np.float32(gain) * light
            spread = noise * (0.002 + 0.006 * np.sqrt(np.maximum(value, 0)))
            value = value + spread * rng.standard_normal(value.shape, dtype=np.float32)
            stored = from_light(np.clip(value, 0, 1), response)
            if depth == 8:
                return np.round(stored * 255).astype(np.uint8)
            return np.round(stored * 65535).astype(np.uint16)

        return (frame(light) for light in self._patterns(program, images))

    def _patterns(self, program: Program, images: Sequence[Floats]) -> Iterator[Floats]:
        """The light arriving of each pattern in order, (height, width, 3) float32."""
        curve = "srgb" if program.monitor.response == "unknown" else program.monitor.response
        for start, part in zip(program.starts, program.parts, strict=False):
            # A monitor pixel belongs to one block: the sums over blocks are exact, and made once a band.
            blocks = self._blocks(part.columns, part.rows) if isinstance(part, Bernoulli) else None
            for first in range(start, start + part.count, BATCH_PATTERNS):
                last = min(first + BATCH_PATTERNS, start + part.count)
                shown = [to_light(v, curve) for v in program.values(first, last, images)]
                if blocks is not None:
                    light = np.stack(shown)
                    yield from self._arriving(blocks, light.reshape(len(light), -1, light.shape[3]))
                elif isinstance(part, Constant):
                    yield from (self.rho * level for level in shown)
                else:
                    yield from (self.composite(image) for image in shown)

    def _blocks(self, columns: int, rows: int) -> Transports:
        """The transport summed over the blocks of a pattern grid, (height * width, rows * columns)."""
        width, height = self.monitor
        row = np.arange(height) * rows // height
        cell = (row[:, None] * columns + np.arange(width) * columns // width).astype(np.int32).ravel()

        made: dict[int, Transport] = {}
        for whole in self.transport:
            if id(whole) not in made:
                entries = (whole.data, cell[whole.indices], whole.indptr)
                blocks = sp.csr_array(
                    entries, shape=(whole.shape[0], rows * columns), dtype=np.float32, copy=True
                )
                blocks.sum_duplicates()
                made[id(whole)] = blocks
        red, green, blue = (made[id(whole)] for whole in self.transport)
        return red, green, blue

    def _arriving(self, transport: Transports, light: Floats) -> Floats:
        """Light (patterns, cells, 1 or 3) through the transport: (patterns, height, width, 3) float32."""
        patterns, _, channels = light.shape
        arriving = np.empty((patterns, self.height * self.width, 3), np.float32)
        for c in range(3):
            if c and channels == 1 and transport[c] is transport[c - 1]:
                arriving[:, :, c] = arriving[:, :, c - 1]
            else:
                arriving[:, :, c] = (transport[c] @ light[:, :, min(c, channels - 1)].T).T
        return arriving.reshape(patterns, self.height, self.width, 3)


def fresnel(cosine: Doubles, index: float) -> tuple[Doubles, Doubles]:
    """Reflection and refraction of unpolarised light at a surface.

    Parameters
    ----------
    cosine : (...) float64
        Of the angle between the incident ray and the normal, above 0.
    index : float
        The refractive index beyond the surface over that before it.

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
) -> Scene:
    """Trace a glass ball before a monitor.

    Parameters
    ----------
    width, height : int
        The camera's pixels.
    monitor : (int, int)
        The monitor's width and height in pixels.
    rays : int
        Rays a camera pixel, a square number: one at random in each cell of a square grid.
    index : float or three
        Refractive index of red, green and blue; below 1 it is a bubble.
    absorption : float or three
        Of red, green and blue, per radius of the ball: over a length s the share exp(-absorption s) is left
        (Beer-Lambert).
    bounces : int
        Reflections inside the ball that are followed.
    seed : int
        Of the rays' places; the same seed gives the same scene.

    Returns
    -------
    Scene

    Raises
    ------
    OptionError
        If ``rays`` is not a square number.

    Notes
    -----
    The light's path is followed backwards, from the camera. At each surface a ray's weight is split by
    Fresnel's equations, nothing is left to chance. What the ball reflects on its outside, and what leaves it
    towards the camera's side or beside the monitor, meets no light: there rho < 1.
    """
    side = math.isqrt(rays)
    if rays < 1 or side * side != rays:
        raise OptionError(f"{rays} rays a pixel make no square grid", field="rays")
    indices = index if isinstance(index, tuple) else (index,) * 3
    absorptions = absorption if isinstance(absorption, tuple) else (absorption,) * 3
    glasses = list(zip(indices, absorptions, strict=True))
    camera = _Camera(width, height, monitor, side, seed)
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

    def trace(self, index: float, absorption: float, bounces: int) -> tuple[Transport, Floats]:
        """The transport and the coverage of a ball."""
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
        """Unit directions (3, n) of rays through pixels, each through a cell of its own."""
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
        """Of rays from points (3, n): those that meet the monitor, the pixel they meet, and their weight."""
        steps = (MONITOR - point[2]) / np.where(direction[2] > 0, direction[2], np.nan)
        x = (point[0] + steps * direction[0]) / self.half_monitor[0]
        y = (point[1] + steps * direction[1]) / self.half_monitor[1]
        met = (np.abs(x) < 1) & (np.abs(y) < 1) & (weight > 0)
        width, height = self.monitor
        column = np.minimum((x[met] + 1) / 2 * width, width - 1).astype(np.intp)
        row = np.minimum((y[met] + 1) / 2 * height, height - 1).astype(np.intp)
        return ray[met], row * width + column, weight[met]


def _through_ball(
    ray: Doubles, index: float, absorption: float, bounces: int
) -> tuple[NDArray[np.bool_], Ends]:
    """Follow rays from the camera (3, n) through the ball.

    Returns
    -------
    hit : (n,) bool
    ends : list of (ray (m,) intp, point (3, m), direction (3, m), weight (m,))
        Where and how rays leave the ball, after each number of inner reflections.

    Notes
    -----
    In a ball every chord of a path has the same length and meets the surface at the same angles. So one
    reflectance R holds all along (it is the same from both sides, Born and Wolf, Sect. 1.5.3), and after k
    inner reflections the share (1 - R)^2 R^k leaves: with the share R that is reflected outside, the whole.
    A ray that got in can't be held by total inner reflection.
    """
    middle = CAMERA * ray[2]
    under = middle**2 - (CAMERA**2 - 1)
    hit = under > 0
    cosine, direction = np.sqrt(under[hit]), ray[:, hit]
    point = (middle[hit] - cosine) * direction
    point[2] -= CAMERA
    # The radius is 1, so a point on the ball is its normal there; ``cosine`` is that of the ray to it.
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
    """Doubles in 0 to 1, of the raw words' top 53 bits: a stable stream, which Generator's is not."""
    return np.asarray((random.random_raw(count) >> np.uint64(11)) * 2.0**-53, np.float64)


def nested_program(
    monitor: tuple[int, int] = (1280, 960),
    bands: Sequence[tuple[int, int, int]] = DEMO_BANDS,
    levels: int = 8,
    seed: int = 7,
) -> Program:
    """A program of constant levels and of random grids.

    Parameters
    ----------
    monitor : (int, int)
        Width and height in pixels.
    bands : sequence of (columns, rows, count)
        From coarse to fine, each grid a whole multiple of the one before.
    levels : int
        Constant levels from 0 to 1, at least 2.
    seed : int
        Of the first band; those after it count on from there.
    """
    grids = [
        Bernoulli(kind="bernoulli", columns=columns, rows=rows, count=count, seed=seed + i)
        for i, (columns, rows, count) in enumerate(bands)
    ]
    constant = Constant(kind="constant", levels=tuple(np.linspace(0, 1, levels).round(6).tolist()))
    return Program(monitor=Monitor(width=monitor[0], height=monitor[1]), parts=(constant, *grids))


def backdrop(width: int = 1280, height: int = 960, seed: int = 0) -> Floats:
    """A backdrop to judge a composite by: a turned checker with white seams, in softly changing colours.

    Parameters
    ----------
    width, height : int
        Pixels.
    seed : int
        Of the colours.

    Returns
    -------
    (height, width, 3) float32
        Linear light, 0 to 1.
    """
    y, x = np.mgrid[:height, :width] / height
    turned = np.stack([0.966 * x + 0.259 * y, 0.966 * y - 0.259 * x]) * 22
    wave = np.sin(np.pi * turned)
    # Edges are soft over a pixel or so, and lie along no pattern's blocks.
    dark = np.clip(0.5 + wave[0] * wave[1] * height / 80, 0, 1)[..., None]
    seam = np.clip(1.6 - np.abs(wave).min(axis=0) * height / 80, 0, 1)[..., None]
    phase = _uniform(np.random.PCG64(seed), 3)
    across, down = np.array([0.7, 0.9, 0.6]), np.array([0.5, -0.6, 0.8])
    colour = 0.5 + 0.42 * np.sin(2 * np.pi * (x[..., None] * across + y[..., None] * down + phase))
    tiles = colour * (1 - dark) + 0.3 * (1 - colour) * dark
    return np.asarray(tiles + (0.95 - tiles) * seam, np.float32)


def write_capture(
    scene: Scene,
    program: Program,
    target: Path | BinaryIO,
    *,
    mask: bool = False,
    name: str = "",
    **film: Unpack[FilmOptions],
) -> int:
    """Film a program and write the capture, a ZIP in the format envmatte-capture/1.

    Parameters
    ----------
    scene : Scene
    program : Program
        Names of the files of `Images` parts are taken as they are; the files are PNG of 16 bits.
    target : Path or binary file
        The same arguments write the same bytes.
    mask : bool
        Whether to add the object's mask.
    name : str
        The capture's name, left out if empty.
    **film
        Options of `Scene.film`.

    Returns
    -------
    int
        The number of frames.

    Raises
    ------
    OptionError
        As `Scene.film`, and nothing is written.
    """
    filmed = scene.film(program, **film)
    frames = [{"file": f"frames/{n:05d}.png", "pattern": n} for n in range(program.count)]
    record = {
        "format": "envmatte-capture/1",
        **({"name": name} if name else {}),
        "program": program.model_dump(mode="json", exclude_defaults=True),
        "response": film.get("response", "linear"),
        "frames": frames,
        **({"mask": "mask.png"} if mask else {}),
    }
    files = [file for part in program.parts if part.kind == "images" for file in part.files]
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:

        def add(entry: str, content: bytes | Frame) -> None:
            info = zipfile.ZipInfo(entry, date_time=(1980, 1, 1, 0, 0, 0))
            info.create_system = 3  # as on Unix, wherever this runs
            archive.writestr(info, content if isinstance(content, bytes) else imagecodecs.png_encode(content))

        add("capture.json", json.dumps(record, indent=1).encode())
        for file, image in zip(files, film.get("images", ()), strict=True):
            pixels = image[:, :, 0] if image.shape[2] == 1 else image
            add(file, np.round(pixels * 65535).astype(np.uint16))
        if mask:
            add("mask.png", scene.object_mask.astype(np.uint8) * np.uint8(255))
        for entry, frame in zip(frames, filmed, strict=True):
            add(str(entry["file"]), frame)
    return program.count
