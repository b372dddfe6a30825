"""Patterns that look alike are distinguished by their times."""

import numpy as np
import pytest

from tests.workflows.ingest.video.camera import film
from tests.workflows.ingest.video.films import CAMERA, PROGRAM, IngestFilm, misplaced, missing
from workflows.ingest.video.recording import Recording
from workflows.programs.program import Program


@pytest.mark.slow
def test_equal_patterns_are_distinguished_by_their_times(
    ingest_film: IngestFilm, light: list[np.ndarray]
) -> None:
    record = PROGRAM.model_dump(mode="json")
    record["parts"][0]["levels"] = [0.0, 1.0, 1.0, 0.5, 0.5]
    program = Program.model_validate(record)
    made = film([light[0], light[4], light[4], light[2], light[2], *light[5:]], CAMERA)
    stack = ingest_film(made.data, program=program)
    assert missing(stack) == []
    assert [pattern for pattern, _ in misplaced(stack, made) if pattern not in (1, 2, 3, 4)] == []


def test_frames_in_which_the_exposure_still_settles_are_left_out() -> None:
    time = np.arange(30)
    settling = 100 * (1 + 0.3 * np.exp(-time / 6))
    flicker = 100 * (1 + 0.03 * (-1.0) ** time)
    for bright, least, most in ((settling, 14, 30), (flicker, 0, 8)):
        codes = np.rint(bright)[:, np.newaxis, np.newaxis, np.newaxis]
        signatures = np.broadcast_to(codes, (30, 24, 32, 3)).astype(np.uint8)
        frames, _ = Recording(signatures, time / 30, 1.0).clean(range(30))
        assert least <= frames[0] <= most
        assert len(frames) >= 2
