"""Films of what `envmatte patterns` shows: the lead-in is distinguished from the patterns after it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from storage.layout.captures import Stack
from tests.workflows.ingest.video.camera import Camera, Film, capture, film, lights
from workflows.programs.border import LEAD, schedule
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball

MONITOR = (192, 144)
HOLD = 0.5


@pytest.fixture
def ingest_film(make_zip: Callable[..., bytes], ingest: Callable[..., Any]) -> Callable[..., Stack]:
    """Films a preset with its lead-in and ingests the film."""

    def run(name: str, camera: Camera) -> tuple[Stack, Film, int]:
        program = preset(name, *MONITOR)
        patterns = lights(glass_ball(96, 72, monitor=MONITOR, rays=4), program)
        dark, bright = np.min(patterns, axis=0), np.max(patterns, axis=0)
        shown = []
        for step in schedule(program.count, 1 / HOLD):
            light = patterns[step.number] if step.number != LEAD else bright if step.white else dark
            shown += [light] * round(step.seconds / HOLD)
        before = next(at for at, light in enumerate(shown) if light is patterns[0])
        made = film(shown, camera)
        manifest, files = capture(program, made.data, 1 / HOLD)
        manifest["video"]["border"] = {"width": 216, "height": 160}
        return ingest("c", make_zip(manifest, files)), made, before

    return run


@pytest.mark.exhaustive
@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("default", marks=pytest.mark.exhaustive),
        "quick",
        pytest.param("sketch", marks=pytest.mark.exhaustive),
    ],
)
@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(
            Camera(hold=HOLD, jitter=0.0, fps=30), id="a player that keeps time", marks=pytest.mark.exhaustive
        ),
        pytest.param(Camera(hold=HOLD, jitter=0.03, fps=25, exposure=0.9), id="one that does not quite"),
    ],
)
def test_lead_in_is_distinguished_from_the_patterns(
    ingest_film: Callable[..., tuple[Stack, Film, int]], name: str, camera: Camera
) -> None:
    stack, made, before = ingest_film(name, camera)
    assert not stack.attributes["video"]["missing"]
    patterns = np.array(stack.attributes["patterns"])
    for at, tick, _ in stack.shares().tolist():
        time = tick * stack.attributes["video"]["tick"]
        k = before + patterns[at]
        assert made.starts[k] - 0.05 < time < made.starts[k + 1] + 0.01


@pytest.mark.slow
def test_a_film_without_the_lead_out_is_read_too(ingest_film: Callable[..., tuple[Stack, Film, int]]) -> None:
    stack, _, _ = ingest_film("sketch", Camera(hold=HOLD, jitter=0.0, tail=-4.2))
    missing = stack.attributes["video"]["missing"]
    assert set(map(int, missing)) <= set(range(33, 37))
