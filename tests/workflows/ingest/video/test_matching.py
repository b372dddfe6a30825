"""Every pattern is made of the right frames, whatever the camera; a film of something else is refused."""

import numpy as np
import pytest

from storage.errors import CaptureError
from tests.workflows.ingest.video.camera import Camera, film
from tests.workflows.ingest.video.films import (
    CAMERA,
    PROGRAM,
    IngestFilm,
    error_of,
    misplaced,
    missing,
    program_with,
)
from workflows.programs.program import Program


@pytest.mark.parametrize(
    "camera",
    [
        Camera(),
        pytest.param(Camera(fps=24, exposure=1.0, seed=1), marks=pytest.mark.exhaustive),
        pytest.param(Camera(fps=25, exposure=1.0, hold=0.4, seed=2), marks=pytest.mark.exhaustive),
        pytest.param(Camera(fps=60, hold=0.1, seed=3), marks=pytest.mark.slow),
        pytest.param(Camera(fps=60, hold=0.15, exposure=1.0, seed=4), marks=pytest.mark.exhaustive),
        pytest.param(Camera(fps=120, hold=0.2, readout=0.008, seed=5), marks=pytest.mark.slow),
        pytest.param(Camera(fps=30000 / 1001, uneven=0.6, seed=6), marks=pytest.mark.slow),
        pytest.param(Camera(fps=30, jitter=0.03, readout=0.033, seed=7), marks=pytest.mark.slow),
        pytest.param(Camera(codec="libx265", seed=8), marks=pytest.mark.slow),
        pytest.param(Camera(codec="mjpeg", container="mov", seed=9), marks=pytest.mark.exhaustive),
        pytest.param(Camera(codec="mjpeg", container="avi", seed=10), marks=pytest.mark.slow),
        pytest.param(Camera(container="matroska", seed=11), marks=pytest.mark.slow),
        pytest.param(Camera(idle=0.0, lead=1.3, seed=12), marks=pytest.mark.exhaustive),
        pytest.param(Camera(lead=0.1, tail=0.1, seed=13), marks=pytest.mark.slow),
        pytest.param(Camera(options={"g": "7", "bf": "2"}, seed=14), marks=pytest.mark.slow),
        pytest.param(Camera(options={"crf": "30"}, seed=15), marks=pytest.mark.exhaustive),
    ],
    ids=str,
)
def test_every_pattern_is_found(ingest_film: IngestFilm, light: list[np.ndarray], camera: Camera) -> None:
    made = film(light, camera)
    stack = ingest_film(made.data, 1 / camera.hold)
    assert misplaced(stack, made) == []
    assert missing(stack) == []
    assert stack.dtype == np.uint16
    assert error_of(stack, made) < (8 if camera.options.get("crf") else 3)
    found = stack.attributes["video"]
    assert found["frames"] == len(made.shown)
    assert found["patterns_per_second"] == pytest.approx(1 / camera.hold, rel=0.1)
    if camera.idle:
        assert found["first_pattern_seconds"] == pytest.approx(made.starts[0], abs=0.5 * camera.hold)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_only_patterns_behind_a_hand_are_missing(ingest_film: IngestFilm, light: list[np.ndarray]) -> None:
    for seed in range(3):
        made = film(light, Camera(hand=(5.0, 6.0), seed=seed))
        stack = ingest_film(made.data)
        behind = np.flatnonzero((made.starts[1:] > 5.0) & (made.starts[:-1] < 6.0)).tolist()
        assert misplaced(stack, made) == []
        assert len(missing(stack)) >= 2
        assert set(missing(stack)) <= set(behind)
        assert error_of(stack, made) < 3


@pytest.mark.parametrize(("camera", "lost"), [(Camera(tail=-1.5), "ends"), (Camera(cut=(-1, 1.8)), "begins")])
@pytest.mark.slow
def test_recording_of_a_part_of_the_program(
    ingest_film: IngestFilm, light: list[np.ndarray], camera: Camera, lost: str
) -> None:
    made = film(light, camera)
    if lost == "begins":  # without black there is no S
        with pytest.raises(CaptureError, match=r"constant patterns are not both found.*begins after"):
            ingest_film(made.data)
        return
    stack = ingest_film(made.data)
    assert misplaced(stack, made) == []
    assert 4 <= len(missing(stack)) <= 7
    assert missing(stack)[-1] == PROGRAM.count - 1
    assert stack.attributes["video"]["missing"][str(PROGRAM.count - 1)] == "the recording ends before it"


def test_film_of_an_unfinished_program_lacks_nothing(
    ingest_film: IngestFilm, light: list[np.ndarray]
) -> None:
    made = film(light, Camera(tail=-6.0))
    with pytest.raises(
        CaptureError, match=r"ends before it; film again: let the recording go on until after"
    ):
        ingest_film(made.data)
    stack = ingest_film(made.data, unfinished=True)
    shown = int((made.starts < made.starts[-1] - 6).sum())
    assert shown - 1 <= stack.frames <= shown < PROGRAM.count - 15
    assert stack.attributes["patterns"] == list(range(stack.frames))
    assert stack.attributes["video"]["missing"] == {}
    assert misplaced(stack, made) == []


def test_film_of_an_unfinished_program_without_patterns_is_refused(
    ingest_film: IngestFilm, light: list[np.ndarray]
) -> None:
    made = film(light, Camera(tail=0.5 - 0.3 * (PROGRAM.count - 3)))
    with pytest.raises(CaptureError, match=r"patterns are (not both )?found: .* ends before it"):
        ingest_film(made.data, unfinished=True)


REFUSED: dict[str, tuple[Camera, Program, str]] = {
    "of another program": (CAMERA, program_with(seed=1), "does not look like the patterns"),
    "of fewer patterns": (CAMERA, program_with(count=30), "do not fit|begins after|are found"),
    "of more patterns": (CAMERA, program_with(count=4), "do not fit|does not look"),
    "cut in the middle": (Camera(cut=(5.0, 7.0)), PROGRAM, "do not fit|does not look|are found"),
    "shown too fast": (Camera(fps=24, hold=0.06), PROGRAM, "never stands still"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_recording_that_does_not_fit_the_program_is_refused(
    ingest_film: IngestFilm, light: list[np.ndarray], case: str
) -> None:
    camera, program, reason = REFUSED[case]
    with pytest.raises(CaptureError, match=reason) as caught:
        ingest_film(film(light, camera).data, 1 / camera.hold, program)
    assert caught.value.fields["entry"] == "clip.mp4"


def test_video_without_changes_is_refused(ingest_film: IngestFilm, light: list[np.ndarray]) -> None:
    with pytest.raises(CaptureError, match="nothing changes"):
        ingest_film(film([light[3]] * 20, Camera(idle=1.0)).data)
