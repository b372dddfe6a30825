"""What recoveries will take and how far off they will be, from trials of an ingest."""

import io
from collections.abc import Callable
from itertools import count

import numpy as np
import pytest
from numba import njit

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from workflows.ingest.pixel_sample import take_sample
from workflows.ingest.trial import qualities
from workflows.ingest.trial.qualities import try_qualities
from workflows.ingest.trial.steadiness import find_steadiness
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture


def stack_of(ingest: Callable[..., Stack], width: int, height: int) -> Stack:
    target = io.BytesIO()
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    write_capture(glass_ball(width, height, monitor=(64, 48), rays=4), program, target, noise=0.5)
    return ingest("c", target.getvalue())


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


def test_compiling_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter((0.0, 60.0, 100.0, 100.5))
    monkeypatch.setattr(qualities.time, "thread_time", lambda: next(clock))
    kernel = njit(lambda: 1)
    assert qualities._seconds(kernel) == 0.5  # the second time


def test_frame_too_small_for_a_trial_has_none(ingest: Callable[..., Stack]) -> None:
    stack = stack_of(ingest, 36, 28)
    assert take_sample(stack) is None
    assert find_steadiness(stack, None) is None
