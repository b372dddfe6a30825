"""Films of a small program, and what must hold for the captures that are made of them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from tests.workflows.ingest.video.camera import TICK, Camera, Film
from workflows.images.tone_curves import from_light
from workflows.programs.program import Program

PROGRAM = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 12), (32, 24, 6)), levels=5)
CAMERA = Camera()
IngestFilm = Callable[..., Stack]
"""The fixture `ingest_film`."""


def program_with(**changes: Any) -> Program:
    """`PROGRAM` with other values for all parts but the constant one."""
    record = PROGRAM.model_dump(mode="json")
    for name, value in changes.items():
        for part in record["parts"][1:]:
            part[name] = value
    return Program.model_validate(record)


def misplaced(stack: Stack, film: Film) -> list[tuple[int, int]]:
    """The frames that were taken for a pattern but show something else: number of the pattern, time."""
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
    """The patterns that no frame was found for."""
    assert sorted({*stack.attributes["patterns"], *map(int, stack.attributes["video"]["missing"])}) == list(
        range(PROGRAM.count)
    )
    return [int(number) for number in stack.attributes["video"]["missing"]]


def error_of(stack: Stack, film: Film) -> float:
    """Root of the mean square error of the mean frames, in 8-bit codes."""
    true = [from_light(np.clip(film.light[n], 0, 1), "srgb") for n in stack.attributes["patterns"]]
    return float(np.sqrt(np.mean((stack.read() / 257 - 255 * np.stack(true)) ** 2)))
