"""A white frame that was exposed for less time than is known: by how much, the patterns tell."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout.captures import Stack
from tests.parts.captures import captured, nested_program
from workflows.images.tone_curves import to_light
from workflows.ingest.pixel_sample import take_sample
from workflows.ingest.trial.steadiness import find_steadiness
from workflows.ingest.trial.trial_recovery import Calibrated
from workflows.ingest.trial.white_exposure import find_white_excess
from workflows.programs.pyramid_light import lay_out
from workflows.simulation.glass_ball import glass_ball

Ingest = Callable[..., Stack]
PROGRAM = nested_program((160, 120), bands=((8, 6, 12), (16, 12, 12), (32, 24, 12), (80, 60, 16)), levels=2)
WHITE = 1


def stack_of(ingest: Ingest, excess: float, light: float = 0.7) -> Stack:
    """White was exposed for so much less time than is known; patterns have so much light, as a share of full scale."""
    scene = glass_ball(80, 60, monitor=(160, 120), rays=4)
    random = np.random.default_rng(5)

    def see(n: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        value = 0.02 + light * scene.composite(to_light(picture, "srgb"))
        return value / (excess if n == WHITE else 1) + 0.004 * random.standard_normal(value.shape)

    return ingest("c", captured(PROGRAM, see))


def found(stack: Stack) -> float:
    sample = take_sample(stack, masked=False)
    assert sample is not None
    capture = Calibrated(stack, PROGRAM, "srgb")
    return float(np.exp(find_white_excess(capture, lay_out(PROGRAM, "srgb", ()), sample)))


@pytest.mark.parametrize("excess", [0.9, pytest.param(1.15, marks=pytest.mark.slow)])
def test_excess_is_found(ingest: Ingest, excess: float) -> None:
    stack = stack_of(ingest, excess)
    measured = dict(stack.attributes)
    assert found(stack) == pytest.approx(excess, rel=0.04)
    assert stack.attributes == measured


def test_excess_is_found_where_patterns_clip_what_they_light(ingest: Ingest) -> None:
    assert found(stack_of(ingest, 1.4, light=1.2)) == pytest.approx(1.4, rel=0.05)


def test_without_contrast_there_is_none(ingest: Ingest) -> None:
    assert found(stack_of(ingest, 1.2, light=0.01)) == 1.0


def test_it_evens_out_the_patterns_of_a_film_whose_exposure_was_free(ingest: Ingest) -> None:
    stack = stack_of(ingest, 1.5)
    exposures = np.where(np.arange(stack.frames) == WHITE, 1, 1.4)
    stack.annotate(auto_exposure=exposures.tolist())
    find_steadiness(stack, take_sample(stack))
    shown = np.isin(stack.attributes["patterns"], PROGRAM.measured)
    gains = np.array(stack.attributes["gains"])
    np.testing.assert_allclose(gains[shown], 1.5 / 1.4, rtol=0.03)
    assert (gains[~shown] == 1).all()
    assert stack.attributes["steadiness"]["flicker"] is None
    assert stack.attributes["shifts"] is None
