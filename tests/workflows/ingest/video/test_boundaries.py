"""Where patterns begin: also without a visible change."""

import numpy as np
import pytest

from tests.workflows.ingest.video.camera import Camera, film
from tests.workflows.ingest.video.films import IngestFilm, misplaced, missing


@pytest.mark.slow
def test_first_pattern_is_found_on_a_monitor_that_showed_it_before(
    ingest_film: IngestFilm, light: list[np.ndarray]
) -> None:
    # nothing shows where the first pattern begins, which is as black as the monitor was before
    made = film([0 * light[0], *light[1:]], Camera(idle=0.0, seed=3))
    stack = ingest_film(made.data)
    assert missing(stack) == []
    assert misplaced(stack, made) == []
