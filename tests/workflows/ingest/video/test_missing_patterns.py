"""What a report says of the patterns that a recording has no frame of."""

import numpy as np
import pytest

from tests.workflows.ingest.video.camera import Camera, film
from tests.workflows.ingest.video.films import PROGRAM, IngestFilm
from workflows.ingest.report.report import report
from workflows.ingest.video.missing_patterns import REMEDIES, Reason, by_reason, ranges, remedy


@pytest.mark.parametrize(
    ("camera", "what"),
    [
        (Camera(hand=(5.0, 6.0)), "keep hands"),
        (Camera(tail=-1.5), "go on until after"),
    ],
    ids=["a hand in front", "ended too early"],
)
@pytest.mark.slow
def test_patterns_without_a_frame_are_named_with_a_remedy(
    ingest_film: IngestFilm, light: list[np.ndarray], camera: Camera, what: str
) -> None:
    stack = ingest_film(film(light, camera).data, 1 / camera.hold)
    made = report(stack.attributes, stack.frames)
    (finding,) = (f for f in made.findings if f.name == "frames")
    assert made.frames.missing
    assert finding.level in ("warning", "bad")
    assert finding.message.startswith(f"{len(made.frames.missing)} of {PROGRAM.count} patterns")
    assert what in finding.remedy
    reasons = stack.attributes["video"]["missing"]
    assert set(reasons.values()) <= REMEDIES.keys()
    for numbers, reason in by_reason({int(number): reason for number, reason in reasons.items()}):
        assert f"{ranges(numbers)} ({reason})" in finding.message


def test_what_is_missing_most_is_remedied_first() -> None:
    reasons = [Reason.AFTER, Reason.TORN, Reason.AFTER]
    first, then = (REMEDIES[reason] for reason in (Reason.AFTER, Reason.TORN))
    assert remedy(reasons) == f"film again: {first}; {then}"


@pytest.mark.parametrize(
    ("numbers", "text"), [([7], "7"), ([1, 2], "1-2"), ([0, 3, 4, 5, 9, 11, 12], "0, 3-5, 9, 11-12")]
)
def test_numbers_in_words(numbers: list[int], text: str) -> None:
    assert ranges(numbers) == text


def test_each_remedy_is_given_once() -> None:
    parts = remedy([*REMEDIES, *REMEDIES]).removeprefix("film again: ").split("; ")
    assert len(parts) == len(set(parts))
    assert {*parts} == {part for each in REMEDIES.values() for part in each.split("; ")}
    assert "show each pattern for longer" in remedy(["a reason of an earlier version"])
