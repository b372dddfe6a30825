"""Traced scenes with exact light transport, filmed with noise, and the backdrops that mattes are judged by."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.field.cameras import CAMERAS, Camera, Seen
from tests.benchmarks.field.methods.method import Film, Floats, Matte, Method
from workflows.programs.parts import Constant, Images, Monitor
from workflows.programs.program import Program
from workflows.simulation import camera as pinhole
from workflows.simulation import objects
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.scene import Scene
from workflows.simulation.tracer import trace

MONITOR = 256, 192
SIZE = 80, 60
"""Of a frame."""
RAYS = 64
SIDE = 4
"""Pixels along a side of the squares that are sampled, of which the camera has a whole number."""
FROST = 5.0
"""How far the frosted ball scatters light, the standard deviation in the monitor's pixels."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Some pixels of a scene, the square that each is of, and the camera."""

    scene: Scene
    chosen: NDArray[np.intp]
    tiles: NDArray[np.intp]
    camera: Camera = CAMERAS["linear"]

    def of(self, frame: Floats) -> Floats:
        """The values (n, 3) of a frame (height, width, 3) at the pixels."""
        return frame.reshape(-1, 3)[self.chosen]


def _pinhole() -> pinhole.Camera:
    return pinhole.Camera(*SIZE, MONITOR, RAYS)


def _ball() -> Scene:
    return glass_ball(*SIZE, monitor=MONITOR, rays=RAYS)


def _lens() -> Scene:
    return trace(objects.lens(0.6), _pinhole())


def _tinted() -> Scene:
    glass = {"index": (1.48, 1.5, 1.53), "absorption": (0.1, 0.3, 0.6)}
    return glass_ball(*SIZE, monitor=MONITOR, rays=RAYS, **glass)  # type: ignore[arg-type]


def _two() -> Scene:
    """A ball and, in a half mirror, a lens."""
    ball, lens = _ball(), _lens()
    both = 0.6 * ball.transport[0] + 0.35 * lens.transport[0]
    return Scene(*SIZE, MONITOR, (both,) * 3, np.minimum(ball.coverage, lens.coverage))


SCENES: dict[str, Callable[[], Scene]] = {
    "ball": _ball,
    "lens": _lens,
    "tumbler": lambda: trace(objects.tumbler(), _pinhole(), index=1.52),
    "tinted": _tinted,
    "frosted": _ball,
    "two layers": _two,
    "stone": lambda: trace(
        objects.stone(), _pinhole(), index=(1.50, 1.52, 1.55), absorption=(0.45, 0.12, 0.04)
    ),
}


def sample(name: str, pixels: int, camera: Camera = CAMERAS["linear"]) -> Sample:
    """Trace a scene, and take squares of about as many pixels of its object, always the same ones."""
    traced = SCENES[name]()
    wide, high = SIZE
    inside = traced.object_mask.reshape(high // SIDE, SIDE, wide // SIDE, SIDE).all(axis=(1, 3))
    squares = np.random.default_rng(0).permutation(np.argwhere(inside))[: max(pixels // SIDE**2, 1)]
    within = np.stack(np.divmod(np.arange(SIDE**2), SIDE), axis=1)
    y, x = np.moveaxis(SIDE * squares[:, None] + within, 2, 0).reshape(2, -1)
    frost = FROST if name == "frosted" else 0.0
    seen = Seen(*SIZE, MONITOR, traced.transport, traced.coverage, frost=frost, lens=camera)
    return Sample(seen, y * wide + x, np.arange(len(squares)).repeat(SIDE**2), camera)


def film(taken: Sample, method: Method, seed: int = 7) -> Film:
    """Show a method's patterns on a linear monitor, and film the sample."""
    camera = taken.camera
    rounds = method.program(*MONITOR)
    shown, frames = [], []
    pictures = next(rounds)
    while True:
        shown += list(pictures)
        names = tuple(str(number) for number in range(len(pictures)))
        parts = (Constant(kind="constant", levels=(0, 1)), Images(kind="images", files=names))
        program = Program(monitor=Monitor(width=MONITOR[0], height=MONITOR[1]), parts=parts)
        images = [picture.astype(np.float32) / 255 for picture in pictures]
        filmed = taken.scene.film(
            program,
            noise=camera.noise,
            depth=camera.depth,
            response=camera.response,
            images=images,
            seed=seed + len(frames),
        )
        values = [taken.of(camera.values(frame)) for frame in filmed]
        frames.append(np.stack(values[2:], axis=1))  # without the constants
        try:
            pictures = rounds.send(frames[-1])
        except StopIteration:
            return Film(shown, np.concatenate(frames, axis=1), taken.tiles, camera.deviation, camera.step)


def backdrops() -> dict[str, Floats]:
    """Light (rows, columns, 3) of the monitor's pixels, 0 to 1."""
    columns, rows = MONITOR
    y, x = np.mgrid[:rows, :columns]
    # Turned, so that it favours no grid.
    fine = ((0.966 * x + 0.259 * y) // 4.5 + (0.966 * y - 0.259 * x) // 4.5) % 2
    across, down = x / columns, y / rows
    return {
        "checks": backdrop(columns, rows),
        "fine checker": np.stack([fine, fine, fine], axis=2).astype(np.float32),
        "ramps": np.stack([across, down, 1 - (across + down) / 2], axis=2).astype(np.float32),
        "strokes": _strokes(np.random.default_rng(1)),
        "photo": _photo(np.random.default_rng(2)),
    }


def _strokes(rng: np.random.Generator) -> Floats:
    """White paper with 60 coloured lines, 2 to 6 pixels wide."""
    columns, rows = MONITOR
    y, x = np.mgrid[:rows, :columns]
    light = np.ones((rows, columns, 3), np.float32)
    for _ in range(60):
        angle, offset, half = rng.uniform(0, np.pi), rng.uniform(-100, 100), rng.uniform(1, 3)
        away = np.abs((x - columns / 2) * np.cos(angle) + (y - rows / 2) * np.sin(angle) - offset)
        light[away < half] = rng.uniform(0, 1, 3)
    return light


def _photo(rng: np.random.Generator) -> Floats:
    """Noise with the spectrum of photographs, amplitudes falling with the frequency, and a horizon."""
    columns, rows = MONITOR
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns))
    frequency[0, 0] = np.inf
    noise = np.fft.rfft2(rng.standard_normal((3, rows, columns))) / frequency
    light = np.moveaxis(np.fft.irfft2(noise, (rows, columns)), 0, 2)
    light /= 4 * light.std()
    light[rows // 2 :] -= 0.3
    return np.clip(0.6 + light, 0, 1).astype(np.float32)


def score(taken: Sample, matte: Matte) -> dict[str, float]:
    """PSNR in dB before each backdrop, over the pixels and channels, against the exact light."""
    found = {}
    for name, light in backdrops().items():
        error = matte.composite(light) - taken.of(taken.scene.truth(light))
        found[name] = float(-10 * np.log10(np.mean(error.astype(np.float64) ** 2)))
    return found
