"""A video capture: every pattern from the right frames, whatever the camera, and what can't be used is refused."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from storage.captures import Stack
from tests.workflows.ingest.camera import TICK, Camera, Film, capture, film, lights
from workflows.program import Program
from workflows.scene import nested_program
from workflows.simulate import glass_ball
from workflows.tone import from_light

Zip = Callable[..., bytes]
Ingest = Callable[..., Stack]
PROGRAM = nested_program((64, 48), ((4, 3, 14), (8, 6, 12), (32, 24, 6)), levels=5)
CAMERA = Camera()


@pytest.fixture(scope="module")
def light() -> list[np.ndarray]:
    return lights(glass_ball(96, 72, monitor=(64, 48), rays=16), PROGRAM)


@pytest.fixture(scope="module")
def filmed(light: list[np.ndarray]) -> Film:
    return film(light, CAMERA)


@pytest.fixture
def take(make_zip: Zip, ingest: Ingest) -> Callable[..., Stack]:
    """Ingests a video as a capture of the program."""

    def run(video: bytes, rate: float = 1 / CAMERA.hold, program: Program = PROGRAM, **more: Any) -> Stack:
        pack = {"pack": more.pop("pack")} if "pack" in more else {}
        return ingest("c", make_zip(*capture(program, video, rate), **pack), **more)

    return run


def wrong(stack: Stack, film: Film) -> list[tuple[int, int]]:
    """The shares of frames that show something else than their pattern."""
    patterns = stack.attributes["patterns"]
    rows = stack.shares()
    assert (np.bincount(rows[:, 0], rows[:, 2]) == 257).all()
    times = np.array(sorted(film.shown))
    found = []
    for at, tick, _ in rows.tolist():
        time = times[np.abs(times - tick * stack.attributes["video"]["tick"] * TICK).argmin()]
        if film.shown[int(time)][patterns[at]] < 0.97:
            found.append((patterns[at], int(time)))
    return found


def missing(stack: Stack) -> list[int]:
    assert sorted({*stack.attributes["patterns"], *map(int, stack.attributes["video"]["missing"])}) == list(
        range(PROGRAM.count)
    )
    return [int(number) for number in stack.attributes["video"]["missing"]]


def error_of(stack: Stack, film: Film) -> float:
    """Root of the mean square error of the mean frames, in 8-bit codes."""
    true = [from_light(np.clip(film.light[n], 0, 1), "srgb") for n in stack.attributes["patterns"]]
    return float(np.sqrt(np.mean((stack.read() / 257 - 255 * np.stack(true)) ** 2)))


@pytest.mark.parametrize(
    "camera",
    [
        Camera(),
        Camera(fps=24, exposure=1.0, seed=1),
        Camera(fps=25, exposure=1.0, hold=0.4, seed=2),
        Camera(fps=60, hold=0.1, seed=3),
        Camera(fps=60, hold=0.15, exposure=1.0, seed=4),
        Camera(fps=120, hold=0.2, readout=0.008, seed=5),
        Camera(fps=30000 / 1001, uneven=0.6, seed=6),
        Camera(fps=30, jitter=0.03, readout=0.033, seed=7),
        Camera(codec="libx265", seed=8),
        Camera(codec="mjpeg", container="mov", seed=9),
        Camera(codec="mjpeg", container="avi", seed=10),
        Camera(container="matroska", seed=11),
        Camera(idle=0.0, lead=1.3, seed=12),
        Camera(lead=0.1, tail=0.1, seed=13),
        Camera(options={"g": "7", "bf": "2"}, seed=14),
        Camera(options={"crf": "30"}, seed=15),
    ],
    ids=str,
)
def test_every_pattern_is_found(take: Callable[..., Stack], light: list[np.ndarray], camera: Camera) -> None:
    made = film(light, camera)
    stack = take(made.data, 1 / camera.hold)
    assert wrong(stack, made) == []
    assert missing(stack) == []
    assert stack.dtype == np.uint16
    assert error_of(stack, made) < (8 if camera.options.get("crf") else 3)
    found = stack.attributes["video"]
    assert found["frames"] == len(made.shown)
    assert found["patterns_per_second"] == pytest.approx(1 / camera.hold, rel=0.1)
    if camera.idle:
        assert found["first_pattern_seconds"] == pytest.approx(made.starts[0], abs=0.5 * camera.hold)
