"""What is found by the figures of a capture: each level, and what to do about it."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np

from storage.layout.captures import Stack
from workflows.ingest.report.findings import Finding
from workflows.ingest.report.report import report
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

DRIFT = {"pixels": 0.3, "error": 0.01, "quarters": [(0.0, 0.0)] * 4, "corrected": False}
FLICKER = {
    "percent": 1.0,
    "error": 0.1,
    "worst_percent": -3.0,
    "worst_frame": 5,
    "follows": 0.0,
    "frames": 37,
    "corrected": False,
}
MISSING = {"7": "the recording ends before it", "8": "the recording ends before it"}


def cases(attributes: dict[str, Any]) -> list[tuple[dict[str, Any], str, str | None, str]]:
    """Attributes that differ; the name and the level of a finding, None if there is none; and some of what it says."""
    survey, storage, frames = attributes["survey"], attributes["storage"], len(attributes["patterns"])

    def surveyed(name: str, **found: float) -> dict[str, Any]:
        return {"survey": survey | {name: survey[name] | found}}

    def steadiness(**found: Any) -> dict[str, Any]:
        return {"steadiness": {"drift": DRIFT, "flicker": FLICKER} | found}

    def exposed(least: float, most: float) -> dict[str, Any]:
        return {"auto_exposure": [least, most, *np.ones(frames - 2).tolist()]}

    film = {"video": {"missing": {}}}
    unexplained = {"pattern_error": 0.03}

    black = surveyed("black", clipped_low=0.4)
    mapped = {"tone_mapping": {"power": 0.2, "spread": 0.1}}
    following = steadiness(flicker=FLICKER | {"follows": -0.5})
    return [
        (surveyed("white", clipped_high=0.004), "exposure", "warning", "a third of a stop less"),
        (surveyed("white", clipped_high=0.04), "exposure", "warning", "half a stop less"),
        (surveyed("white", clipped_high=0.06), "exposure", "bad", "a stop less"),
        (surveyed("white", reaches=0.51), "exposure", "good", ""),
        (surveyed("white", reaches=0.49), "exposure", "warning", "half a stop more"),
        (surveyed("white", reaches=0.12), "exposure", "bad", "2.5 stops more"),
        ({"storage": storage | {"bounded": False}}, "exposure", None, ""),
        (surveyed("black", clipped_low=0.1), "black", "warning", "raise the camera's black level"),
        (black, "black", "bad", "raise the camera's black level"),
        (black | {"storage": storage | {"black": 4096}}, "black", "good", ""),
        (steadiness(drift=None) | unexplained, "steadiness", "warning", "switch HDR"),
        (steadiness(flicker=None) | unexplained, "steadiness", "warning", "switch HDR"),
        (steadiness(flicker=None) | unexplained | exposed(1.0, 2.0), "steadiness", None, ""),
        ({"steadiness": {}, "pattern_error": 0.005}, "steadiness", "good", ""),
        (steadiness(), "steadiness", None, ""),
        (steadiness(), "drift", "warning", "it is not corrected"),
        (steadiness(drift=DRIFT | {"error": 0.1}), "drift", "good", ""),
        (steadiness(drift=DRIFT | {"corrected": True, "error": 0.1}), "drift", "good", ""),
        (steadiness(drift=DRIFT | {"corrected": True, "pixels": 1.0}), "drift", "warning", "only in part"),
        (steadiness(), "flicker", "warning", "it is not corrected"),
        (steadiness(flicker=FLICKER | {"error": 0.3}), "flicker", "good", ""),
        (steadiness(flicker=FLICKER | {"corrected": True}), "flicker", "good", ""),
        (
            steadiness(flicker=FLICKER | {"percent": 12.0, "corrected": True}),
            "flicker",
            "bad",
            "only in part",
        ),
        (
            steadiness(flicker=FLICKER | {"white_percent": -8.0}),
            "white",
            "warning",
            "make the monitor darker",
        ),
        (steadiness(flicker=FLICKER | {"white_percent": 40.0}), "white", "bad", "lock exposure"),
        (steadiness(flicker=FLICKER | {"white_percent": -2.0}), "white", None, ""),
        (following, "tone_mapping", "warning", "switch HDR"),
        (following, "flicker", None, ""),
        (following | mapped, "flicker", "warning", "it is not corrected"),
        (mapped, "tone_mapping", "warning", "switch HDR"),
        ({"tone_mapping": {"power": 0.05, "spread": 0.1}}, "tone_mapping", "good", ""),
        ({"glare": [0.02, 0.02]}, "glare", "warning", "clean the lens"),
        ({"glare": [0.2, 0.2]}, "glare", "bad", "clean the lens"),
        (exposed(0.98, 1.02), "auto_exposure", "good", ""),
        (film | exposed(0.9, 1.0), "auto_exposure", "warning", "lock exposure"),
        (film | exposed(1.0, 1.3), "auto_exposure", "bad", "followed only in part"),
        (exposed(1.0, 1.3), "auto_exposure", "bad", "by hand for all stills: so large"),
        (
            {"white_balance": [[1.06, 1.0, 0.94], *np.ones((frames - 1, 3)).tolist()]},
            "white_balance",
            "warning",
            "lock white balance",
        ),
        ({"crosstalk": [[1, 0.35, 0], [0, 1, 0], [0, 0, 1]]}, "crosstalk", "warning", ""),
        ({"scaled": True}, "scaling", "warning", "Ctrl+0"),
        ({"survey": survey | {"deviation": survey["contrast"] / 20}}, "noise", "warning", "expose longer"),
        ({"survey": survey | {"deviation": survey["contrast"] / 5}}, "noise", "bad", "expose longer"),
        ({"video": {"missing": dict([*MISSING.items()][:1])}}, "frames", "warning", "go on until after"),
        (
            {"video": {"missing": MISSING | {"9": "too short", "10": "too short"}}},
            "frames",
            "bad",
            "film again",
        ),
    ]


def test_figures_are_graded_and_bad_ones_have_a_remedy(ingest: Callable[..., Stack]) -> None:
    target = io.BytesIO()
    scene = glass_ball(48, 36, monitor=(160, 120), rays=4)
    write_capture(scene, preset("sketch", 160, 120), target, mask=True)
    stack = ingest("c", target.getvalue())

    def found(changed: dict[str, Any]) -> dict[str, Finding]:
        made = report(stack.attributes | changed, stack.frames)
        assert made.level == made.findings[0].level  # the worst comes first
        return {one.name: one for one in made.findings}

    assert {one.level for one in found({}).values()} == {"good"}
    for changed, name, level, said in cases(stack.attributes):
        one = found(changed).get(name)
        assert (one and one.level) == level, (changed, one)
        if one is not None:
            assert said in one.remedy, changed
            # Of its own colours the camera can't be rid.
            assert bool(one.remedy) == (level != "good" and name != "crosstalk"), changed
