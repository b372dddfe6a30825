"""Findings on the frames themselves: which there are, and whether they show what they are said to."""

from collections.abc import Iterable, Sequence
from typing import Any

from workflows.ingest.report.figures import Figures, Finding, graded
from workflows.ingest.video.missing_patterns import by_reason, ranges, remedy

NAMED = 8
"""Runs of frames whose files are named, at most: the app translates no longer sentences."""
SPREAD = 0.25
"""Share of the picture from which on constant frames that differ are bad."""


def frames(figures: Figures) -> Finding:
    """The patterns that have frames, and those that have none."""
    missing = {int(number): why for number, why in figures.video["missing"].items()} if figures.video else {}
    if missing:
        which = "; ".join(f"{ranges(numbers)} ({why})" for numbers, why in by_reason(missing))
        return Finding(
            name="frames",
            level=graded(len(missing) / figures.frames.patterns, 0, 0.1),
            message=f"{len(missing)} of {figures.frames.patterns} patterns have no frame that can be used: {which}",
            remedy=remedy(missing.values()),
        )
    if figures.frames.missing:
        return Finding(
            name="frames",
            level="good",
            message=f"{figures.frames.kept} frames of the {figures.frames.patterns - len(figures.frames.missing)} "
            f"patterns shown so far; the program has {figures.frames.patterns}",
        )
    several = f", in {figures.frames.exposures} exposures" if figures.frames.exposures > 1 else ""
    return Finding(
        name="frames",
        level="good",
        message=f"{figures.frames.kept} frames of all {figures.frames.patterns} patterns{several}",
    )


def order(kind: str, first: int, by: int, files: Sequence[str] | None) -> Finding:
    """The frames are in another order than capture.json says; see `workflows.ingest.trial.frame_order.Order`."""
    if kind == "unlike":
        return Finding(
            name="order",
            level="bad",
            message="the frames do not look like the patterns of the program",
            remedy="check that capture.json has the program that was shown, that its frames are in the order in which "
            "they were taken, and that the camera sees the monitor",
        )
    message = {
        "reversed": "the frames are in reverse order",
        "rolled": f"the frames are in another order: the first one shows pattern {by}, as when names of files begin "
        "again at 0001",
        "shifted": f"from frame {named([first], files)} on each shows a pattern that comes {abs(by)} "
        + (
            "later than its own: a still is missing"
            if by > 0
            else "earlier than its own: there is a still too many"
        ),
    }[kind]
    return Finding(
        name="order",
        level="bad",
        message=message,
        remedy="make the archive again, with one still of each pattern in the order in which they were shown",
    )


def named(numbers: Iterable[int], files: Sequence[str] | None) -> str:
    """Ascending numbers of frames in words, with the names of their files, if these are stills.

    Examples
    --------
    >>> named([0, 2, 3], ["a/IMG_1.JPG", "a/IMG_2.JPG", "a/IMG_3.JPG", "a/IMG_4.JPG"])
    '0 (IMG_1.JPG), 2-3 (IMG_3.JPG … IMG_4.JPG)'
    """
    words = ranges(numbers)
    runs = words.split(", ")
    if files is None or len(runs) > NAMED:
        return words
    ends = [[files[int(end)].rpartition("/")[2] for end in run.split("-")] for run in runs]
    return ", ".join(f"{run} ({' … '.join(of)})" for run, of in zip(runs, ends, strict=True))


def odd_frames(odd: list[int], files: Sequence[str] | None) -> Finding | None:
    """Single frames that do not show their patterns."""
    if not odd:
        return None
    return Finding(
        name="odd_frames",
        level="warning",
        message="not all frames show their patterns, as with a hand in the picture, a flash, or another still in "
        f"the place of one: recovery does without {named(odd, files)}",
        remedy="keep everything still and dark while the patterns are shown, and take one still of each",
    )


def constants(apart: dict[str, Any] | None, files: Sequence[str] | None) -> Finding | None:
    """Frames of black, or of white, that differ."""
    if apart is None:
        return None
    return Finding(
        name="constants",
        level=graded(apart["share"], 0, SPREAD),
        message=f"frames {named(apart['frames'], files)} were taken of the same, but differ in "
        f"{100 * apart['share']:.0f} % of the picture by more than a tenth of white",
        remedy="take all again with exposure and white balance locked, the light of the room as it is, and camera "
        "and glass at rest",
    )
