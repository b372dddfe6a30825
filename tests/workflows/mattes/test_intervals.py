"""The interval of a matte: what the ingest measured, and what held-out patterns can't show."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from storage.layout.captures import Stack
from workflows.mattes.options import parse_options
from workflows.mattes.steps import _interval
from workflows.programs.presets import preset

FOUND = {"contrast": 0.1, "read": 1e-5, "shot": 1e-4, "share": 1e-3}
LOCKED = [1.0, 1.01, 0.99] * 20
FREE = [0.8, 1.0, 1.25] * 20


def interval(
    options: dict[str, Any] | None = None, program: str = "default", **attributes: Any
) -> dict[str, float]:
    stack = SimpleNamespace(attributes={"intervals": {"fine": FOUND}, "survey": {}} | attributes)
    found = _interval(cast(Stack, stack), preset(program), parse_options(options or {}))
    return cast(dict[str, float], found.get("interval", {}))


def test_a_recovery_by_a_quality_has_what_the_ingest_measured() -> None:
    assert interval() == FOUND
    assert interval(auto_exposure=LOCKED) == FOUND


def test_colours_that_a_film_has_lost_count() -> None:
    survey = {"lost_colour": 1e-4}
    assert interval(survey=survey) == FOUND | {"read": pytest.approx(1.1e-4)}
    assert interval(survey=survey, program="quick") == FOUND  # patterns in colour show it themselves


def test_an_exposure_that_was_not_locked_counts_in_proportion_to_the_light() -> None:
    left = 0.35 * float(np.log(FREE).std())
    assert interval(auto_exposure=FREE) == FOUND | {"share": pytest.approx(1e-3 + left**2 / 3)}


@pytest.mark.parametrize("options", [{"quality": "fast"}, {"method": "nn-dgsr"}])
def test_what_the_ingest_has_not_tried_has_none(options: dict[str, Any]) -> None:
    assert interval(options) == {}
