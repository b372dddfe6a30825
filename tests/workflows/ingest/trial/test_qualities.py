"""What recoveries will take and how far off they will be, from trials of an ingest."""

import io
from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
import pytest
from numba import njit

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from workflows.images.resample import area_mean
from workflows.ingest.pixel_sample import see_sample, take_sample
from workflows.ingest.trial import qualities
from workflows.ingest.trial.qualities import try_qualities
from workflows.ingest.trial.steadiness import find_steadiness
from workflows.ingest.trial.trial_recovery import Calibrated, RecoveredSample, recover_seen
from workflows.programs.parts import Bernoulli, Constant, Monitor, Part, Stripes
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.interval import local_contrast
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

MONITOR = 64, 48


def stack_of(ingest: Callable[..., Stack], width: int, height: int, program: Program | None = None) -> Stack:
    target = io.BytesIO()
    program = program or nested_program(MONITOR, bands=((4, 3, 14), (8, 6, 10)), levels=5)
    write_capture(glass_ball(width, height, monitor=MONITOR, rays=4), program, target, noise=0.5)
    return ingest("c", target.getvalue())


def program_of(*parts: Part) -> Program:
    levels = Constant(kind="constant", levels=(0, 0, 1, 1))
    return Program(monitor=Monitor(width=MONITOR[0], height=MONITOR[1]), parts=(levels, *parts))


@pytest.mark.slow
def test_seconds_of_a_trial_count_for_all_pixels(
    ingest: Callable[..., Stack], monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = stack_of(ingest, 80, 60)
    sample = take_sample(stack)
    assert sample is not None
    tried = sample.some_squares()
    assert 0.5 < len(tried.chosen[0]) / len(sample.chosen[0]) < 2
    whole = stack.mask()[tuple(tried.places)]
    assert whole.all()
    assert 0.9 < sample.wanted / np.count_nonzero(stack.mask()) < 1  # some see nothing of the monitor
    share = sample.wanted / len(whole)
    assert share > 1
    clock = count()  # each trial lasts a second
    monkeypatch.setattr(qualities.time, "thread_time", lambda: float(next(clock)))
    program = Program.model_validate(stack.attributes["program"])
    patterns = lay_out(program, "linear", stack.images())
    tried = try_qualities(stack, sample, patterns)
    assert tried is not None
    assert {name: quality.seconds for name, quality in tried.items()} == {
        "fine": round(share, 2),
        "fast": round(share, 2),
    }


def test_a_few_random_patterns_are_held_out_of_each_square(
    ingest: Callable[..., Stack], monkeypatch: pytest.MonkeyPatch
) -> None:
    grids = Bernoulli(kind="bernoulli", columns=8, rows=6, count=20, seed=1, offset=True)
    program = program_of(Stripes(kind="stripes", axis="x", count=5), grids)
    stack = stack_of(ingest, 80, 60, program)
    sample = take_sample(stack)
    assert sample is not None
    patterns = lay_out(program, "linear")
    tries = []
    recover = qualities.recover_seen

    def spy(*args: Any) -> RecoveredSample | None:
        tries.append(args[-1])
        return recover(*args)

    spread = sample.blocks()
    seen = see_sample(stack, spread, np.zeros((stack.frames, 2)))
    monkeypatch.setattr(qualities, "recover_seen", spy)
    capture = Calibrated(stack, program, "linear")
    found = qualities._intervals(capture, patterns, spread, seen, np.zeros(stack.frames))
    assert all(found.values())
    fine, fast = tries
    assert (fine == fast).all()
    assert not fine[:, :5].any()
    assert fine[:, 5:].any(axis=0).all()  # each in some squares
    assert 0 < fine.mean(axis=1).min() <= fine.mean(axis=1).max() <= 1 / 6
    for square in np.unique(spread.chosen[0]):
        of_square = fine[spread.chosen[0] == square]
        assert (of_square == of_square[0]).all()


@pytest.mark.slow
def test_intervals_from_stripes_alone_hold_backdrops_that_were_not_shown(
    ingest: Callable[..., Stack], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = program_of(*(Stripes(kind="stripes", axis=axis, count=5) for axis in ("x", "y")))
    stack = stack_of(ingest, 80, 60, program)
    sample = take_sample(stack)
    assert sample is not None
    patterns, still = lay_out(program, "linear"), np.zeros(stack.frames)
    spread = sample.blocks()
    seen = see_sample(stack, spread, np.zeros((stack.frames, 2)))
    capture = Calibrated(stack, program, "linear")
    made = recover_seen(capture, patterns, seen, still, places=spread.places.T)
    assert made is not None
    rng = np.random.default_rng(5)
    grids = [
        rng.integers(0, 2, (rows, columns, 1)).astype(np.float32) for columns, rows in ((6, 4), (16, 12))
    ]
    scene = glass_ball(80, 60, monitor=MONITOR, rays=4)

    def held() -> float:
        interval = qualities._intervals(capture, patterns, spread, seen, still)["fine"]
        assert interval is not None
        inside = []
        for grid in grids:
            light = np.repeat(area_mean(grid, *MONITOR), 3, axis=2)
            mean, square = (patterns.pyramid.light(area_mean(part, *MONITOR)) for part in (light, light**2))
            S, rho = made.photometry.S, made.photometry.rho
            composite = S + rho * made.transport.apply(mean)
            arrived = rho * made.transport.apply(local_contrast(patterns.pyramid, mean, square))
            error = composite - scene.truth(light)[tuple(spread.places)]
            inside.append(np.abs(error) <= interval.half_width(composite, rho, arrived))
        return float(np.mean(inside))

    assert 0.86 < held() < 0.94
    monkeypatch.setattr(qualities, "MOST_LEVERAGE", 0.0)  # by the errors of stripes that the fit has seen
    assert held() < 0.8


def test_compiling_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter((0.0, 60.0, 100.0, 100.5))
    monkeypatch.setattr(qualities.time, "thread_time", lambda: next(clock))
    kernel = njit(lambda: 1)
    assert qualities._seconds(kernel) == 0.5  # the second time


def test_frame_too_small_for_a_trial_has_none(ingest: Callable[..., Stack]) -> None:
    stack = stack_of(ingest, 36, 28)
    assert take_sample(stack) is None
    assert find_steadiness(stack, None) is None
