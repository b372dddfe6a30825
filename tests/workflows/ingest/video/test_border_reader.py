"""The border in a recording: found in perspective, its numbers read, whatever is missing of the recording."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from storage.errors import CaptureError
from storage.layout.captures import Stack
from tests.workflows.ingest.video.camera import TICK, Camera, Film, capture, film
from workflows.ingest.video.border_reader import find_by_numbers
from workflows.ingest.video.recording import Recording
from workflows.ingest.video.signatures import LargeFrames
from workflows.programs.border import LEAD, Border, draw_border, schedule
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball

BORDER = Border.on(640, 480)
WIDTH, HEIGHT = 224, 168
HOLD = 0.25
ASKEW = ((20, 14), (16, 156), (203, 24), (210, 150))
"""Where the camera sees the display's corners: left top, left bottom, right top, right bottom."""


def through(corners: Any) -> Callable[[np.ndarray], np.ndarray]:
    """A camera's view of a display: (rows, columns, 3) float32 of the same."""
    rows = []
    known = np.array([(0, 0), (0, BORDER.height), (BORDER.width, 0), (BORDER.width, BORDER.height)], float)
    seen = np.array(corners, float)
    for (x, y), (u, v) in zip(seen, known, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    matrix = np.append(np.linalg.solve(np.array(rows), known.ravel()), 1).reshape(3, 3)
    down, across = (np.mgrid[: 3 * HEIGHT, : 3 * WIDTH] + 0.5) / 3
    x, y, scale = np.tensordot(matrix, np.stack([across, down, np.ones_like(down)]), 1)
    column, row = np.floor(x / scale).astype(int), np.floor(y / scale).astype(int)
    inside = (column >= 0) & (column < BORDER.width) & (row >= 0) & (row < BORDER.height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)

    def view(display: np.ndarray) -> np.ndarray:
        seen = np.where(inside[..., None], display[row, column], np.float32(0.02))
        return np.broadcast_to(
            seen.reshape(HEIGHT, 3, WIDTH, 3, -1).mean(axis=(1, 3)), (HEIGHT, WIDTH, 3)
        ).copy()

    return view


@pytest.fixture
def ingest_film(make_zip: Callable[..., bytes], ingest: Callable[..., Any]) -> Callable[..., Any]:
    """Films a preset, with a glass ball before the display, and ingests the film."""
    _, _, width, height = BORDER.inner
    program = preset("sketch", width, height)
    ball = glass_ball(WIDTH // 2, HEIGHT // 2, monitor=(width, height), rays=1)
    pictures = list(program.pictures(0, program.count))

    def run(
        camera: Camera, corners: Any = ASKEW, border: Border = BORDER, **more: Any
    ) -> tuple[Stack, Film, list[int]]:
        view, numbers, shown = through(corners), [], []
        for step in schedule(program.count, 1 / HOLD):
            picture = np.full((height, width, 1), float(step.white), np.float32)
            if step.number != LEAD:
                picture = pictures[step.number]
            codes = np.round(255 * picture).astype(np.uint8)
            light = view(draw_border(codes, step.number, BORDER).astype(np.float32) / 255)
            glass = ball.truth(np.broadcast_to(picture, (height, width, 3)))
            light[HEIGHT // 4 : HEIGHT // 4 + HEIGHT // 2, WIDTH // 4 : WIDTH // 4 + WIDTH // 2] = glass
            repeats = round(step.seconds / HOLD)
            shown += [light] * repeats
            numbers += [step.number] * repeats
        made = film(shown, camera)
        manifest, files = capture(program, made.data, 1 / camera.hold)
        manifest["video"]["border"] = border.model_dump(mode="json")
        return ingest("c", make_zip(manifest | more, files)), made, numbers

    return run


def misplaced(stack: Stack, made: Film, numbers: list[int]) -> list[tuple[int, int]]:
    """The frames that were taken for a pattern but show something else: number of the pattern, time."""
    times, tick = np.array(sorted(made.shown)), stack.attributes["video"]["tick"]
    found = []
    for at, ticks, _ in stack.shares().tolist():
        time = int(times[np.abs(times - ticks * tick * TICK).argmin()])
        pattern = stack.attributes["patterns"][at]
        own = [share for share, number in zip(made.shown[time], numbers, strict=False) if number == pattern]
        if sum(own) < 0.97:
            found.append((pattern, time))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "corners"),
    [
        pytest.param(Camera(hold=HOLD), ASKEW, id="askew"),
        pytest.param(
            Camera(hold=HOLD, fps=24, exposure=1.0),
            ASKEW,
            id="24 frames a second, all of them exposed",
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(
            Camera(hold=0.1, fps=60), ASKEW, id="10 patterns a second", marks=pytest.mark.exhaustive
        ),
        pytest.param(
            Camera(hold=HOLD, options={"crf": "32"}),
            ((2, 3), (2, 164), (221, 3), (222, 165)),
            id="compressed",
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(
            Camera(hold=HOLD),
            ((20, 14), (16, 190), (203, 24), (210, 187)),
            id="bottom hidden",
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(Camera(hold=HOLD), ASKEW[::-1], id="upside down", marks=pytest.mark.exhaustive),
    ],
)
def test_every_number_is_read(ingest_film: Callable[..., Any], camera: Camera, corners: Any) -> None:
    stack, made, numbers = ingest_film(camera, corners)
    assert stack.attributes["video"]["numbered"]
    assert stack.attributes["video"]["missing"] == {}
    assert misplaced(stack, made, numbers) == []
    assert stack.attributes["video"]["patterns_per_second"] == pytest.approx(1 / camera.hold, rel=0.1)
    assert stack.attributes["video"]["first_pattern_seconds"] == pytest.approx(
        made.starts[numbers.index(0)], abs=0.5 * camera.hold
    )


def test_unfinished_film_has_the_patterns_that_were_shown(ingest_film: Callable[..., Any]) -> None:
    stack, made, numbers = ingest_film(Camera(hold=HOLD, tail=-8.0), unfinished=True)
    shown = max(np.array(numbers)[: (made.starts < made.starts[-1] - 8).sum()]) + 1
    assert stack.attributes["video"]["numbered"]
    assert shown - 1 <= stack.frames <= shown < 20
    assert stack.attributes["patterns"] == list(range(stack.frames))
    assert stack.attributes["video"]["missing"] == {}
    assert misplaced(stack, made, numbers) == []


def test_film_of_a_longer_program_is_refused(ingest_film: Callable[..., Any]) -> None:
    program = preset("sketch", *BORDER.inner[2:])
    shorter = program.model_copy(update={"parts": program.parts[:-2]})
    with pytest.raises(CaptureError, match=r"program of 37 patterns or more, .* has 32: choose the program"):
        ingest_film(Camera(hold=HOLD), program=shorter.model_dump(mode="json"))


@pytest.mark.exhaustive
@pytest.mark.slow
def test_cut_film_lacks_only_the_patterns_cut_out(ingest_film: Callable[..., Any]) -> None:
    stack, made, numbers = ingest_film(Camera(hold=HOLD, cut=(7.0, 9.0)))
    gone = [numbers[k] for k in np.flatnonzero((made.starts[1:] > 7.0) & (made.starts[:-1] < 9.0))]
    missing = [int(number) for number in stack.attributes["video"]["missing"]]
    assert stack.attributes["video"]["numbered"]
    assert len(missing) >= 6
    assert set(missing) <= set(gone)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_only_patterns_behind_a_hand_are_missing(ingest_film: Callable[..., Any]) -> None:
    stack, made, numbers = ingest_film(Camera(hold=HOLD, hand=(7.0, 8.0)))
    behind = [numbers[k] for k in np.flatnonzero((made.starts[1:] > 7.0) & (made.starts[:-1] < 8.0))]
    assert stack.attributes["video"]["numbered"]
    assert {int(number) for number in stack.attributes["video"]["missing"]} <= set(behind)
    assert {pattern for pattern, _ in misplaced(stack, made, numbers)} <= set(behind)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_patterns_are_found_by_their_times_without_the_sides_of_the_border(
    ingest_film: Callable[..., Any],
) -> None:
    stack, made, numbers = ingest_film(
        Camera(hold=HOLD, jitter=0.02), ((-20, 14), (-18, 156), (240, 24), (235, 150))
    )
    assert not stack.attributes["video"]["numbered"]
    assert stack.attributes["video"]["missing"] == {}
    assert misplaced(stack, made, numbers) == []


@pytest.mark.slow
def test_cut_film_without_numbers_is_refused(ingest_film: Callable[..., Any]) -> None:
    with pytest.raises(CaptureError, match=r"do not fit|does not look|are found"):
        ingest_film(Camera(hold=HOLD, cut=(7.0, 9.0)), ((-20, 14), (-18, 156), (240, 24), (235, 150)))


def test_noise_has_no_numbers() -> None:
    random = np.random.Generator(np.random.PCG64(0))
    steps = np.repeat(random.integers(0, 256, (40, 24, 32, 3), np.uint8), 6, axis=0)
    recording = Recording(steps, np.arange(240) / 30, 0.2)
    assert len(recording.events) == 39
    grey = np.repeat(random.integers(0, 256, (40, 96, 128), np.uint8), 6, axis=0)
    assert find_by_numbers(recording, LargeFrames(grey, np.arange(240)), BORDER, 32) is None


def test_numbers_are_read_where_the_exposure_settles_while_patterns_are_shown() -> None:
    random = np.random.default_rng(0)
    _, _, width, height = BORDER.inner
    view, patterns, frames = through(ASKEW), 20, []
    for number in range(patterns):
        blocks = random.integers(0, 2, (6, 8, 1), np.uint8).repeat(height // 6, 0).repeat(width // 8, 1)
        picture = np.full((height, width, 1), 128, np.uint8)
        picture[: blocks.shape[0], : blocks.shape[1]] = 255 * blocks
        light = view(draw_border(picture, number, BORDER).astype(np.float32) / 255)[..., 0]
        for exposure in (1.0, 0.7) if number % 2 else (0.7, 1.0):
            seen = 230 * exposure * light.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
            frames += [seen + 0.2 * random.standard_normal(seen.shape) for _ in range(6)]
    grey = np.clip(np.rint(frames), 0, 255).astype(np.uint8)
    small = grey.reshape(len(grey), 12, 7, 16, 7).mean(axis=(2, 4))
    signatures = np.repeat(np.rint(small).astype(np.uint8)[..., np.newaxis], 3, axis=3)
    recording = Recording(signatures, np.arange(len(grey)) / 24, 0.5)
    found = find_by_numbers(recording, LargeFrames(grey, np.arange(len(grey))), BORDER, patterns)
    assert found is not None
    assert [set(shown // 12) for shown in found.frames] == [{number} for number in range(patterns)]
