"""What ingest notes in the attributes of a stack."""

import numpy as np
import pytest

from tests.workflows.ingest.video.camera import film
from tests.workflows.ingest.video.films import CAMERA, IngestFilm
from workflows.ingest.light.stack_attributes import clipped_from, shortest_frames


def test_shortest_frames_are_those_of_the_patterns_in_the_shortest_exposure() -> None:
    attributes = {"patterns": [0, 0, 1, 2, 1], "exposures": [0.5, 1.0, 0.5, 0.5, 0.5]}
    assert shortest_frames(attributes, np.array([0, 1])).tolist() == [0, 2, 4]


@pytest.mark.parametrize(
    ("gain", "least"), [pytest.param(1.0, 65535, marks=pytest.mark.slow), (2.5, int(0.97 * 65535))]
)
def test_values_of_a_film_that_clips_count_as_clipped_a_little_below_full_scale(
    ingest_film: IngestFilm, light: list[np.ndarray], gain: float, least: int
) -> None:
    stack = ingest_film(film([np.float32(gain) * one for one in light], CAMERA).data)
    assert clipped_from(stack) == least
