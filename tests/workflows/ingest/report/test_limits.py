"""What limits composites is graded by what it costs, and what was not measured is never good."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from tests.workflows.ingest.trial.test_unexplained import filmed
from workflows.images.tone_curves import Gamma
from workflows.ingest.report.figures import Finding, Quality, ToneCurve
from workflows.ingest.report.limits import lost_colour, quality, unexplained
from workflows.ingest.report.report import Report, report
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball

Ingest = Callable[..., Stack]
MONITOR = 160, 120


@pytest.mark.parametrize(
    ("low", "high", "level"), [(41, 50, "good"), (26, 33, "warning"), (18, 25, "bad"), (24, 40, "good")]
)
def test_expected_quality_is_graded(low: float, high: float, level: str) -> None:
    expected = Quality(low=low, high=high, blocks=None)
    found = quality(expected, random=True, exposed=False)
    assert found is not None
    assert found.level == level
    assert bool(found.remedy) == (level != "good")
    assert f"{low} dB (dispersion, many edges) to {high} dB (clear glass)" in found.message
    found = quality(expected, random=True, exposed=True)
    assert found is not None
    assert (
        f"{low} dB (if the scene is to be exposed otherwise) to {high} dB (exposed as white" in found.message
    )


def test_exposure_decides_no_end_of_what_stripes_alone_promise() -> None:
    found = quality(Quality(low=30, high=38, blocks=None), random=False, exposed=True)
    assert found is not None
    assert "30 dB (backdrops finer than the patterns) to 38 dB (coarser ones)" in found.message


def test_nothing_is_said_of_an_unknown_quality() -> None:
    assert quality(None, random=True, exposed=False) is None


@pytest.mark.parametrize(("cost", "level"), [(1e-3, "warning"), (1e-2, "bad")])
def test_errors_are_graded_by_their_cost(cost: float, level: str) -> None:
    found = unexplained(cost, 0.03)
    assert found is not None
    assert (found.level, found.cost) == (level, cost)
    assert f"about {-10 * np.log10(cost):.0f} dB" in found.message
    assert unexplained(1e-5, 0.003) is None


@pytest.fixture(scope="module")
def program() -> Program:
    return nested_program(MONITOR, bands=((8, 6, 12), (16, 12, 12), (32, 24, 12)), levels=2)


def test_lost_detail_of_colours_is_that_of_patterns_in_colour_or_else_of_the_glass(program: Program) -> None:
    of_glass = lost_colour(program, 1e-3, half_colour=True)
    assert of_glass is not None
    assert (of_glass.name, of_glass.cost) == ("colour_detail", 1e-3)
    assert lost_colour(program, 1e-5, half_colour=True) is None
    coloured = preset("quick")
    assert lost_colour(coloured, 0.0, half_colour=False) is None
    for cost, level, said in (
        (0.0, "warning", "up to 8 dB"),
        (1e-3, "warning", "about 30 dB"),
        (1e-2, "bad", "20 dB"),
    ):
        of_patterns = lost_colour(coloured, cost, half_colour=True)
        assert of_patterns is not None
        assert (of_patterns.name, of_patterns.level) == ("coloured_patterns", level)
        assert said in of_patterns.message


@pytest.fixture
def stack(ingest: Ingest, program: Program) -> Stack:
    return ingest("c", filmed(glass_ball(80, 60, monitor=MONITOR, rays=4), program))


def findings(stack: Stack, **other: Any) -> tuple[Report, dict[str, Finding]]:
    made = report(stack.attributes | other, stack.frames)
    return made, {finding.name: finding for finding in made.findings}


def test_what_is_not_measured_is_listed_and_nowhere_good(stack: Stack) -> None:
    made, found = findings(stack)
    assert made.camera == ToneCurve(curve="linear", source="given")
    assert found["unmeasured"].level == "warning"
    assert found["unmeasured"].message == (
        "not measured: whether the monitor scaled the patterns; the camera's curve, which the capture states"
    )
    assert not {"camera_curve", "scaling"} & set(found)
    assert found["drift"].level == found["noise"].level == "good"
    made, found = findings(stack, steadiness=None, pattern_error=None, noise_of_patterns=False)
    for what in ("drift", "flicker", "glare", "noise"):
        assert what in found["unmeasured"].message
        assert what not in found
    assert "constant frames" in found["unmeasured"].remedy


def test_drift_and_flicker_that_cannot_show_are_not_missed(stack: Stack) -> None:
    free = {"auto_exposure": [1.0, 2.0, *np.ones(len(stack.attributes["patterns"]) - 2).tolist()]}
    for other, drift, flicker, remedy in (
        ({}, False, False, "half-tones"),
        ({"pattern_error": 0.03}, True, True, "nothing that moves"),
        (free, False, True, "set exposure and ISO by hand"),
    ):
        _, found = findings(stack, steadiness={}, **other)
        assert ("drift" in found["unmeasured"].message) == drift
        assert ("flicker" in found["unmeasured"].message) == flicker
        assert remedy in found["unmeasured"].remedy


def test_stated_curve_is_checked_by_half_tones(stack: Stack) -> None:
    survey = stack.attributes["survey"]
    _, found = findings(stack, survey=survey | {"halftones_apart": 0.01})
    assert found["camera_curve"].level == "good"
    assert "half-tones agree" in found["camera_curve"].message
    _, found = findings(stack, survey=survey | {"halftones_apart": -0.11})
    assert found["camera_curve"].level == "warning"
    assert "-11 % of white" in found["camera_curve"].message
    assert "unknown" in found["camera_curve"].remedy


def test_curves_of_each_channel_are_named(stack: Stack) -> None:
    curves = ["linear", "srgb", {"gamma": 3.0}]
    made, found = findings(stack, camera_curve=curves, response="unknown")
    assert made.camera.curve == ("linear", "srgb", Gamma(gamma=3))
    assert "red has 50, green 21 and blue 12 % of the light" in found["camera_curve"].message


def test_of_one_level_the_costliest_comes_first(stack: Stack) -> None:
    survey = stack.attributes["survey"]
    for lost, error, first in ((1e-3, 0.02, "colour_detail"), (2e-4, 0.04, "unexplained")):
        made, _ = findings(stack, smooth_error=error, survey=survey | {"lost_colour": lost})
        assert made.findings[0].name == first
        costs = [finding.cost for finding in made.findings if finding.level == "warning"]
        assert costs[:2] == sorted(costs[:2], reverse=True)
