"""What explains a sample: by which pixels local tone mapping and the rest are found."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from storage.layout.captures import Stack
from workflows.ingest.trial import explanation
from workflows.programs.presets import preset


def measured(exposed: list[float] | None = None, masked: bool = False) -> Stack:
    """A stack whose curves and noise are known."""
    attributes = dict.fromkeys(explanation.MEASURED, 0.0) | {
        "auto_exposure": exposed,
        "tone_mapping": None,
        "monitor_curve": "srgb",
        "camera_curve": "srgb",
        "scaled": False,
        "storage": {"black": 0},
    }
    stack = SimpleNamespace(
        attributes=attributes,
        annotate=lambda **found: attributes.update(found),
        dtype=np.dtype(np.uint8),
        frames=2,
        images=list,
        mask=lambda: np.array([True, not masked]),
    )
    return cast(Stack, stack)


@pytest.mark.parametrize(
    ("border", "exposed", "asked"),
    [(True, None, True), (True, [1.0, 1.1], True), (True, [1.0, 2.0], False), (False, None, False)],
)
def test_border_tells_tone_mapping_if_the_exposure_was_locked(
    monkeypatch: pytest.MonkeyPatch, border: bool, exposed: list[float] | None, asked: bool
) -> None:
    taken: list[Any] = []
    values: Any = SimpleNamespace(fit=lambda look_up, local: "light of the border")
    monkeypatch.setattr(
        explanation,
        "find_unexplained",
        lambda *given: SimpleNamespace(rest=None, patterns=None, recovered=None),
    )
    monkeypatch.setattr(explanation, "find_tone_mapping", lambda *given: taken.append(given[-1]))
    monkeypatch.setattr(explanation, "find_covered", lambda *given: False)
    known = values if border else None
    sample = cast(Any, None)
    explanation.explain(measured(exposed), preset("sketch", 320, 240), sample, known)
    assert taken == ["light of the border" if asked else None]


def test_tone_mapping_is_told_by_pixels_around_the_mask_and_the_rest_by_those_in_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stack, tried = measured(masked=True), []

    def find_unexplained(capture: Any, patterns: Any, sample: str, state: Any) -> Any:
        tried.append((sample, stack.attributes["model_error"]))
        stack.annotate(model_error=0.1)
        return SimpleNamespace(rest=f"rest of {sample}", patterns=None, recovered=None)

    def find_tone_mapping(_: Stack, rest: str, sample: str, *known: Any) -> None:
        assert (rest, sample) == ("rest of all", "all")

    monkeypatch.setattr(explanation, "take_sample", lambda stack, masked: "masked" if masked else "all")
    monkeypatch.setattr(explanation, "find_unexplained", find_unexplained)
    monkeypatch.setattr(explanation, "find_tone_mapping", find_tone_mapping)
    monkeypatch.setattr(explanation, "find_covered", lambda *given: False)
    sample = cast(Any, "masked")
    explained = explanation.explain(stack, preset("sketch", 320, 240), sample, None)
    assert explained is not None
    assert explained.unexplained.rest == "rest of masked"
    assert tried == [("all", 0.0), ("masked", 0.0)]  # what the first has measured does not count
