"""The glass drawn from the EXR alone, as the module that writes it says; and mattes and backdrops for it."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from storage.layout import mattes, uploads
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows.images.resample import area_mean
from workflows.ingest.steps import STEPS as INGEST
from workflows.jobs import Steps, Task, run
from workflows.mattes.steps import STEPS as RECOVER
from workflows.programs.presets import preset
from workflows.recovery.pyramid import Pyramid
from workflows.simulation import glass_ball
from workflows.simulation import objects as glass
from workflows.simulation.camera import Camera
from workflows.simulation.scene import Scene, write_capture
from workflows.simulation.tracer import trace
from workflows.untrusted.limits import Limits

CROSSTALK = [[0.9, 0.1, 0], [0.05, 0.8, 0.15], [0.02, 0.18, 0.8]]
MONITOR = 640, 480
SIZE = 96, 72
Image = NDArray[np.float32]


BESIDE = {"sight": [[1.6, 0.1, -0.3], [0.06, 1.7, -0.4], [0.08, -0.05, 1]], "rho": [0.8, 0.7, 0.6]}
"""A camera that sees more than the monitor, a little from the side."""


def few_nodes(objects: Objects, most: int, **attributes: Any) -> Matte:
    """A matte with a few nodes of T in each pixel, which lookups hold exactly."""
    height, width, columns, rows = 20, 35, 75, 37
    rng = np.random.default_rng(0)
    nodes = Pyramid.over(columns, rows).nodes
    sizes = {"height": height, "width": width, "columns": columns, "rows": rows}
    made = mattes.create(objects, "few", **sizes, monitor=[150, 74], crosstalk=CROSSTALK, **attributes)
    for at in np.ndindex(made.block_rows, made.block_columns):
        shape = tuple(part.stop - part.start for part in made.span(*at))
        recovered = rng.random(shape) < 0.8
        S, rho = (rng.random((2, *shape, 3), np.float32) * recovered[..., np.newaxis]).astype(np.float32)
        count = np.zeros((*shape, 3), np.uint32)
        count[..., 0] = rng.integers(1, most + 1, shape) * recovered
        cells = [np.sort(rng.choice(nodes, n, replace=False)) for n in count[..., 0].flat]
        weights = [(w := rng.random(n) + 0.1) / w.sum() for n in count[..., 0].flat]
        cell, weight = np.concatenate(cells).astype(np.uint32), np.concatenate(weights).astype(np.float32)
        made.write(*at, Block(S, rho, np.zeros(shape, np.float32), recovered, recovered, count, cell, weight))
    return made


def recovered(objects: Objects, name: str) -> Matte:
    """A traced glass, filmed with the program `quick` and recovered: a ball, a lens or a tumbler."""
    scene = _scene(name)
    mask = {} if name == "ball" else {"mask": scene.coverage > 0}
    file = io.BytesIO()
    write_capture(scene, preset("quick", *MONITOR), file, offset=0.004, gain=0.95, **mask)
    objects.put(uploads.part_path(name, "all"), file.getvalue())
    uploads.seal(objects, name, [uploads.Part("all", len(file.getvalue()))])
    limits = Limits(1 << 32, 1 << 28)
    _run(INGEST, objects, Task("job", name, "", {}, limits))
    _run(RECOVER, objects, Task("job", name, name, {"quality": "fast"}, limits))
    return Matte(objects, name)


def backdrops() -> dict[str, Image]:
    """Linear light of the monitor's size: a photo-like picture, tiles, strokes, a ramp and a checker."""
    width, height = MONITOR
    y, x = np.mgrid[:height, :width]
    rng = np.random.default_rng(3)
    strokes = np.full((height, width, 3), 0.9)
    for _ in range(14):
        angle, (left, top) = np.pi * rng.random(), rng.random(2) * MONITOR
        away = np.abs((x - left) * np.sin(angle) - (y - top) * np.cos(angle))
        strokes[away < rng.uniform(3, 10)] = rng.random(3)
    pictures = {
        "photo": _photo(width, height, rng),
        "tiles": glass_ball.backdrop(width, height),
        "strokes": strokes,
        "ramp": np.stack([x / width, y / height, 1 - x / width], axis=-1),
        "checker": np.repeat(((x // 20 + y // 20) % 2)[..., np.newaxis], 3, axis=-1),
    }
    return {name: np.ascontiguousarray(picture, np.float32) for name, picture in pictures.items()}


def plate_and_backdrop(matte: Matte) -> tuple[Image, Image]:
    """What the frame would see without the glass, four times as fine as the matte, and what the monitor would show."""

    def light(places: NDArray[np.float64]) -> Image:
        x, y = np.moveaxis(places, -1, 0)
        bands = [0.5 + 0.3 * np.sin(5 * x + k) + 0.15 * np.cos(4 * y - 2 * k) for k in range(3)]
        return np.stack(bands, axis=-1).astype(np.float32)

    def pixels(width: int, height: int) -> NDArray[np.float64]:
        return np.stack(np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height), -1)

    frame = pixels(4 * matte.width, 4 * matte.height)
    seen = np.concatenate([frame, np.ones_like(frame[..., :1])], axis=-1) @ np.transpose(BESIDE["sight"])
    return light(seen[..., :2] / seen[..., 2:]), light(pixels(*matte.attributes["monitor"]))


def _photo(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """A picture with the spectrum of photographs, amplitudes in inverse proportion to frequency, and with edges."""
    down, across = np.fft.fftfreq(height)[:, np.newaxis], np.fft.rfftfreq(width)
    amplitude = 1 / np.maximum(np.hypot(down, across), 1 / width)
    amplitude[0, 0] = 0
    y, x = np.mgrid[:height, :width]
    channels = []
    for _ in range(3):
        phase = np.exp(2j * np.pi * rng.random(amplitude.shape))
        picture = np.fft.irfft2(amplitude * phase, (height, width))
        channels.append(0.4 + 0.15 * picture / picture.std())
    light = np.stack(channels, axis=-1)
    light[y > height * 0.6 + 40 * np.sin(x / 70)] *= 0.4  # a dark foreground
    light[(x - 0.7 * width) ** 2 + (y - 0.25 * height) ** 2 < 45**2] = (1, 0.95, 0.8)  # and a sun
    return np.clip(light, 0, 1)


def read_channels(path: Path) -> tuple[dict[str, Image], oiio.ImageSpec]:
    """The channels of an EXR by name, and its header."""
    held = oiio.ImageBuf(str(path))
    assert not held.has_error, held.geterror()
    pixels = held.get_pixels(oiio.FLOAT)
    return {name: pixels[..., c] for c, name in enumerate(held.spec().channelnames)}, held.spec()


def write_picture(path: Path, light: Image) -> None:
    """Write a picture (height, width, 3) as EXR."""
    held = oiio.ImageBuf(oiio.ImageSpec(light.shape[1], light.shape[0], 3, oiio.FLOAT))
    held.set_pixels(oiio.ROI(), light)
    assert held.write(str(path)), held.geterror()


def draw(path: Path, backdrop: Image) -> NDArray[np.float64]:
    """The glass of an EXR of lookups in front of a backdrop, (height, width, 3)."""
    channels, spec = read_channels(path)
    columns, rows = spec.getattribute("cells")
    pyramid = Pyramid.over(columns, rows)
    light = pyramid.light(area_mean(backdrop, columns, rows))

    def image(name: str) -> NDArray[np.float64]:
        return np.stack([channels[f"{name}.{c}"] for c in "RGB"], axis=-1).astype(float)

    arrived = np.zeros(image("S").shape)
    for k in range(sum(name.startswith("weight") and name.endswith(".R") for name in channels)):
        u, v, level = np.moveaxis(image(f"lookup{k}"), -1, 0)
        for n, (across, down) in enumerate(pyramid.grids):
            nodes = light[pyramid.starts[n] : pyramid.starts[n + 1]].reshape(down, across, 3)
            x = np.clip(u * columns / 2**n - 0.5, 0, across - 1)
            y = np.clip((1 - v) * rows / 2**n - 0.5, 0, down - 1)
            seen = np.zeros_like(arrived)
            for i, j in np.ndindex(2, 2):
                at = np.minimum(y.astype(int) + i, down - 1), np.minimum(x.astype(int) + j, across - 1)
                share = np.abs(1 - i - y % 1) * np.abs(1 - j - x % 1)
                seen += share[..., np.newaxis] * nodes[at]
            arrived += image(f"weight{k}") * np.maximum(0, 1 - np.abs(level - n))[..., np.newaxis] * seen
    return image("S") + (image("rho") * arrived) @ np.reshape(spec.getattribute("crosstalk"), (3, 3)).T


def psnr(picture: NDArray[np.floating], expected: NDArray[np.floating], where: NDArray[np.bool_]) -> float:
    """PSNR of the first three channels of a picture where something was recovered."""
    return float(-10 * np.log10(np.mean((picture[..., :3] - expected[..., :3])[where] ** 2)))


def _scene(name: str) -> Scene:
    if name == "ball":
        return glass_ball.glass_ball(*SIZE, monitor=MONITOR, rays=16)
    solid = {"lens": glass.lens, "tumbler": glass.tumbler}[name]()
    return trace(solid, Camera(*SIZE, MONITOR, 16), index=1.52, room=glass.window)


def _run(steps: Steps, objects: Objects, task: Task) -> None:
    _, plan = run(steps, objects, task, PREPARE)
    for step in (*range(plan["tiles"]), FINISH):
        run(steps, objects, replace(task, plan=plan), step)
