"""A film of a small program, ingested as a capture."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from storage.layout.captures import Stack
from tests.workflows.ingest.video.camera import Film, capture, film, lights
from tests.workflows.ingest.video.films import CAMERA, PROGRAM
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball


@pytest.fixture(scope="session")
def light() -> list[np.ndarray]:
    """The light of each pattern of `PROGRAM` behind a glass ball."""
    return lights(glass_ball(96, 72, monitor=(64, 48), rays=16), PROGRAM)


@pytest.fixture(scope="session")
def filmed(light: list[np.ndarray]) -> Film:
    """All patterns of `PROGRAM`, filmed by `CAMERA`."""
    return film(light, CAMERA)


@pytest.fixture
def ingest_film(make_zip: Callable[..., bytes], ingest: Callable[..., Stack]) -> Callable[..., Stack]:
    """Ingests a video as a capture of a program."""

    def run(video: bytes, rate: float = 1 / CAMERA.hold, program: Program = PROGRAM, **more: Any) -> Stack:
        pack = {"pack": more.pop("pack")} if "pack" in more else {}
        manifest, files = capture(program, video, rate)
        manifest["unfinished"] = more.pop("unfinished", False)
        return ingest("c", make_zip(manifest, files, **pack), **more)

    return run
