"""Mattes of captures whose patterns were exposed so long that what is bright clipped."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from imagecodecs import png_encode

from storage.layout.captures import Stack
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows.composite import composite
from workflows.images.resample import area_mean
from workflows.jobs import Task, run_all
from workflows.mattes.steps import STEPS
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.scene import Scene
from workflows.untrusted.limits import Limits

MONITOR = 256, 192


def stills(scene: Scene, program: Program, longer: float) -> Iterator[np.ndarray]:
    """Frames of 16 bits, those of patterns so many times as long."""
    usual, long = (scene.film(program, gain=0.9 * t, offset=0.02 * t, depth=16) for t in (1.0, longer))
    for number, frames in enumerate(zip(usual, long, strict=True)):
        yield frames[int(number in program.measured)]


@pytest.mark.parametrize(("longer", "least"), [(1.0, 30), (2.0, 27)])
def test_clipped_patterns_still_tell_where_light_comes_from(
    objects: Objects,
    make_zip: Callable[..., bytes],
    ingest: Callable[..., Stack],
    longer: float,
    least: float,
) -> None:
    scene, program = glass_ball(40, 30, monitor=MONITOR, rays=9), preset("sketch", *MONITOR)
    files = {
        f"{n:03d}.png": bytes(png_encode(frame)) for n, frame in enumerate(stills(scene, program, longer))
    }
    files["mask.png"] = bytes(png_encode(scene.object_mask.astype(np.uint8) * np.uint8(255)))
    exposures = [longer if n in program.measured else 1.0 for n in range(program.count)]
    frames = [
        {"file": f"{n:03d}.png", "pattern": n, "exposure": exposure} for n, exposure in enumerate(exposures)
    ]
    manifest = {
        "format": "envmatte-capture/1",
        "program": program.model_dump(mode="json", exclude_defaults=True),
        "response": "linear",
        "frames": frames,
        "mask": "mask.png",
    }
    ingest("c", make_zip(manifest, files))
    task = Task("j", "c", "m", {"quality": "fast"}, Limits(1 << 30, 1 << 26))
    run_all(STEPS, objects, task)
    light = area_mean(backdrop(*MONITOR), *MONITOR)
    made, truth = composite(Matte(objects, "m"), light)[..., :3], scene.truth(light)
    seen = scene.object_mask
    assert -10 * np.log10(np.mean((made - truth)[seen] ** 2)) > least
