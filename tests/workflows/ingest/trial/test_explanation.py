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
        "white_balance": None,
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
        channels=1,
        images=list,
        mask=lambda: np.array([True, not masked]),
    )
    return cast(Stack, stack)


def unexplained(left: float) -> Any:
    """What a recovery has left so much unexplained of."""
    return SimpleNamespace(rest=SimpleNamespace(size=lambda: left), patterns=None, recovered=None)


@pytest.mark.parametrize(
    ("border", "exposed", "asked"),
    [(True, None, True), (True, [1.0, 1.1], True), (True, [1.0, 2.0], False), (False, None, False)],
)
def test_border_tells_tone_mapping_if_the_exposure_was_locked(
    monkeypatch: pytest.MonkeyPatch, border: bool, exposed: list[float] | None, asked: bool
) -> None:
    taken: list[Any] = []
    values: Any = SimpleNamespace(fit=lambda *given: "light of the border")
    monkeypatch.setattr(
        explanation,
        "find_unexplained",
        lambda *given: unexplained(1.0),
    )
    monkeypatch.setattr(explanation, "find_tone_mapping", lambda *given: taken.append(given[-1]))
    monkeypatch.setattr(explanation, "find_covered", lambda *given: False)
    known = values if border else None
    sample = cast(Any, None)
    explanation.explain(measured(exposed), preset("sketch", 320, 240), sample, known)
    assert taken == ["light of the border" if asked else None]


def test_tone_mapping_is_measured_around_the_mask_and_the_rest_in_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stack, tried = measured(masked=True), []

    def find_unexplained(capture: Any, patterns: Any, sample: str, state: Any) -> Any:
        tried.append((sample, stack.attributes["model_error"]))
        stack.annotate(model_error=0.1)
        return unexplained(0.1 if sample == "all" else 0.2)

    def find_tone_mapping(_: Stack, rest: Any, sample: str, *known: Any) -> None:
        assert (rest.size(), sample) == (0.1, "all")

    monkeypatch.setattr(explanation, "take_sample", lambda stack, masked: "masked" if masked else "all")
    monkeypatch.setattr(explanation, "find_unexplained", find_unexplained)
    monkeypatch.setattr(explanation, "find_tone_mapping", find_tone_mapping)
    monkeypatch.setattr(explanation, "find_covered", lambda *given: False)
    sample = cast(Any, "masked")
    explained = explanation.explain(stack, preset("sketch", 320, 240), sample, None)
    assert explained is not None
    assert explained.unexplained.rest.size() == 0.2
    assert tried == [("all", 0.0), ("masked", 0.0)]  # what the first has measured does not count


@pytest.mark.parametrize(
    ("left", "border", "kept"), [(0.09, False, True), (0.11, False, False), (0.11, True, True)]
)
def test_tone_mapping_that_explains_nothing_is_left_out_unless_the_border_tells_it(
    monkeypatch: pytest.MonkeyPatch, left: float, border: bool, kept: bool
) -> None:
    stack, asked = measured(), []

    def calibrate(stack: Stack, border: Any, tone_mapping: Any = None) -> None:
        stack.annotate(tone_mapping=tone_mapping)

    def find_tone_mapping(*given: Any) -> dict[str, float] | None:
        asked.append(given)
        return {"power": 0.1} if len(asked) == 1 else None

    def find_unexplained(*given: Any) -> Any:
        return unexplained(left if stack.attributes["tone_mapping"] else 0.1)

    monkeypatch.setattr(explanation, "calibrate", calibrate)
    monkeypatch.setattr(explanation, "find_tone_mapping", find_tone_mapping)
    monkeypatch.setattr(explanation, "find_unexplained", find_unexplained)
    monkeypatch.setattr(explanation, "find_covered", lambda *given: False)
    values: Any = SimpleNamespace(fit=lambda *given: "light of the border") if border else None
    monkeypatch.setattr(explanation, "local_gain", lambda stack: None)
    explained = explanation.explain(stack, preset("sketch", 320, 240), cast(Any, None), values)
    assert explained is not None
    assert stack.attributes["tone_mapping"] == ({"power": 0.1} if kept else None)
    assert explained.unexplained.rest.size() == (left if kept else 0.1)
