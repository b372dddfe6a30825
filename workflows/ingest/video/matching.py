"""Match the frames of a video to the patterns that they show, and decide whether enough of them were found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import CaptureError
from workflows.ingest.manifest import Video
from workflows.ingest.video import lead_in, resemblance
from workflows.ingest.video.border_reader import find_by_numbers
from workflows.ingest.video.border_spill import without_border
from workflows.ingest.video.boundaries import Edge
from workflows.ingest.video.frame_means import Share, shares_of
from workflows.ingest.video.missing_patterns import Reason, by_reason, ranges, remedy
from workflows.ingest.video.recording import Recording
from workflows.ingest.video.signatures import LargeFrames, Signatures
from workflows.ingest.video.timing import FoundPatterns, find_by_timing
from workflows.programs.program import Program

Doubles = NDArray[np.float64]

MAX_MATCHED = 2000
"""Patterns of a program that is filmed: matching takes memory in proportion to their square."""
MIN_SHARE = 0.6
"""A recording with a smaller share of the patterns that are not constant is refused."""
MIN_RESEMBLANCE = 2.5
"""A recording with a smaller `resemblance.score` is refused."""
MANY = 32
"""Random patterns from which on the score counts for more than the numbers in a border: the right program's, if it has
fewer, may be as small as a wrong one's."""
EDGES: tuple[tuple[tuple[Edge, Edge], ...], ...] = (
    (("seen", "seen"), ("hidden", "seen"), ("seen", "hidden"), ("hidden", "hidden")),
    (("seen", "cut"), ("cut", "seen"), ("hidden", "cut"), ("cut", "hidden")),
)
"""How the program may begin and end, the more likely cases first."""
_AS_LIKELY = 10.0  # difference of negative log likelihoods up to which timings count as equally likely
_EVENTS = 2  # for each pattern, at most
_RESTLESS = 5.0  # codes of noise: nothing stands still
_GAMMA = 2.2  # close enough to any camera's curve to compare what it saw


@dataclass(frozen=True)
class Expected:
    """What a video should show.

    Attributes
    ----------
    program : Program
    light : (patterns, rows, columns, 3) float32
        Of its patterns, see `resemblance.coarse_light`.
    video : Video
        If it has a border, the patterns were shown in it, between a lead-in and a lead-out; see
        `workflows.programs.border.schedule`.
    unfinished : bool
        Whether the program need not have been shown to its end: what was not is not missing.
    """

    program: Program
    light: resemblance.Light
    video: Video
    unfinished: bool

    @property
    def rate(self) -> float:
        """About how many patterns were shown in a second."""
        return self.video.patterns_per_second

    @property
    def has_border(self) -> bool:
        return self.video.border is not None

    def refusal(self, reason: str) -> CaptureError:
        """The error to raise if the video shows something else."""
        return CaptureError(f"{self.video.file}: {reason}", entry=self.video.file)


@dataclass(frozen=True)
class MatchedFrames:
    """The frames of each pattern, and what to report about them.

    Attributes
    ----------
    shares : dict of int to list of Share
        The frames of each pattern that was found.
    record : dict
        What was found, as JSON: ``tick`` in seconds, ``frames`` that were decoded, ``kept`` ones, ``numbered``: whether
        patterns were found by the numbers in the border, ``first_pattern_seconds``, ``patterns_per_second``,
        ``resemblance``, and ``missing``: the reason for each pattern without frames.
    notes : list of str
        The same in words.
    """

    shares: dict[int, list[Share]]
    record: dict[str, Any]
    notes: list[str]

    @property
    def table(self) -> NDArray[np.int64]:
        """All shares, (k, 3) int64: index of the pattern among those found, tick, weight."""
        rows = [(n, *share) for n, shares in enumerate(self.shares.values()) for share in shares]
        return np.array(rows, np.int64)


def match_frames(
    signatures: Signatures, ticks: NDArray[np.int64], tick: float, large: LargeFrames, expected: Expected
) -> MatchedFrames:
    """Match the frames of a recording to the patterns of a program.

    Parameters
    ----------
    signatures : (frames, rows, columns, 3) uint8
    ticks : (frames,) int64
        When each frame is shown.
    tick : float
        Length of a tick in seconds.
    large : LargeFrames
        Used with a border only.
    expected : Expected

    Raises
    ------
    CaptureError
        If too little of the program is found.
    """
    program, border = expected.program, expected.video.border
    recording = Recording(signatures, (ticks - ticks[0]) * tick, 1 / expected.rate)
    found = find_by_numbers(recording, large, border, program.count) if border is not None else None
    numbered = found is not None
    if found is not None and found.longer:
        raise expected.refusal(
            f"it shows a program of {found.longer} patterns or more, by the numbers in its border, but that of "
            f"capture.json has {program.count}: choose the program that was shown"
        )
    if found is None:
        found = _by_timing(recording, expected)
    looks, score, odd = _compare(recording, found, expected)
    looks = {number: look for number, look in looks.items() if number not in odd}
    reasons = found.reasons | dict.fromkeys(odd, Reason.ODD)
    _require_resemblance(expected, looks, odd, score, numbered)
    shown = max(looks, default=-1) + 1 if expected.unfinished else program.count
    _require_enough(expected, shown, looks, reasons)
    reasons = {number: reason for number, reason in sorted(reasons.items()) if number < shown}
    kept = sorted(looks)
    shares = {number: shares_of(ticks[found.frames[number]], found.weights[number]) for number in kept}
    record = {
        "tick": tick,
        "frames": len(ticks),
        "kept": sum(len(share) for share in shares.values()),
        "numbered": numbered,
        "first_pattern_seconds": round(found.start, 3),
        "patterns_per_second": round(found.rate, 4),
        "resemblance": None if score is None else round(score, 1),
        "missing": {str(number): reason for number, reason in reasons.items()},
    }
    notes = [_summary(record, len(kept), shown), *_by_reason(reasons)]
    if border is not None and not numbered:
        notes.append(
            "the numbers in the border can't be read: patterns are found by the times of the changes"
        )
    return MatchedFrames(shares, record, notes)


def _by_timing(recording: Recording, expected: Expected) -> FoundPatterns:
    """Find the frames of each pattern by the times of the changes, after a lead-in if there is one."""
    frames, begins, ends = slice(0, len(recording.times)), False, False
    if expected.has_border:
        frames, first, ends = lead_in.find_patterns(recording)
        recording = Recording(recording.signatures[frames], recording.times[frames], 1 / expected.rate)
        begins = first is not None
        if first is not None:
            lead_in.begin_at(recording, first)
    count = expected.program.count
    if not recording.events and recording.noise.max(initial=0) > _RESTLESS:
        raise expected.refusal(
            "the picture changes from each frame to the next and never stands still: record more frames a second, show "
            "fewer patterns a second, and keep the camera at rest"
        )
    if not recording.events:
        raise expected.refusal("nothing changes in the video: film the monitor while it shows the program")
    if len(recording.events) > _EVENTS * count + 100:
        raise expected.refusal(
            f"the picture changes {len(recording.events)} times, but the program has {count} patterns: keep "
            "the camera, the light and the glass at rest, and cut off what does not belong to the program"
        )
    found = _best(recording, expected, begins, ends)
    start = found.start + float(recording.times[0])
    return replace(found, frames=[some + frames.start for some in found.frames], start=start)


def _best(recording: Recording, expected: Expected, begins: bool, ends: bool) -> FoundPatterns:
    """Of the matches that fit the timing, choose the one that looks most like the program.

    The whole program is tried first, then all of it but its end or its beginning. If a lead-in or a lead-out was found,
    the program ``begins`` or ``ends`` with the first or the last event.
    """
    flat = expected.light.reshape(len(expected.light), -1)
    same = (flat[1:] == flat[:-1]).all(axis=1)
    for edges in EDGES:
        tried = [
            find_by_timing(recording, expected.rate, same, begin, end)
            for begin, end in edges
            if (begin == "seen" or not begins) and (end == "seen" or not ends)
        ]
        fitting = [found for found in tried if found is not None and not found.jumps]
        if fitting:
            break
    else:
        raise expected.refusal(
            f"the {len(recording.events)} changes in the video do not fit {expected.program.count} patterns at "
            f"{expected.rate:g} a second: check that capture.json has the program that was shown and its "
            "patterns_per_second, and record all of it in one go, with everything at rest"
        )
    least = min(found.cost for found in fitting)
    likely = [found for found in fitting if found.cost <= least + _AS_LIKELY]

    def quality(found: FoundPatterns) -> float:
        _, score, odd = _compare(recording, found, expected)
        return (score or 0.0) - len(odd)

    return likely[0] if len(likely) == 1 else max(sorted(likely, key=lambda found: found.cost), key=quality)


def _compare(
    recording: Recording, found: FoundPatterns, expected: Expected
) -> tuple[dict[int, Doubles], float | None, list[int]]:
    """What the camera saw of each pattern, in approximately linear light; the score of that; the odd patterns."""
    program, light = expected.program, expected.light
    looks = {n: (recording.look(f) / 255) ** _GAMMA for n, f in enumerate(found.frames) if f.size}
    if expected.has_border:
        looks = without_border(program, looks)
    return looks, resemblance.score(program, light, looks), resemblance.odd_patterns(program, light, looks)


def _require_resemblance(
    expected: Expected, looks: Mapping[int, Doubles], odd: list[int], score: float | None, numbered: bool
) -> None:
    """Require that most constant patterns are not odd, and that the others look right, or are few and ``numbered``."""
    wrong = np.isin(expected.program.constants[0], odd).mean() > 0.5
    unlike = score is not None and score < MIN_RESEMBLANCE
    few = resemblance.compared(expected.program, looks) < MANY
    if wrong or (unlike and not (numbered and few)):
        raise expected.refusal(
            "what changes in the video does not look like the patterns of the program: check that capture.json has the "
            "program that was shown and its patterns_per_second, and film from a tripod"
        )


def _require_enough(
    expected: Expected, shown: int, looks: Mapping[int, Doubles], reasons: Mapping[int, Reason]
) -> None:
    """Require black, white, and most of the other patterns, of the first that were ``shown``."""
    numbers, sent = expected.program.constants
    there = np.isin(numbers, list(looks))
    why = "; ".join(_by_reason(reasons))
    if not there.any() or (np.ptp(sent[there], axis=0) < np.ptp(sent, axis=0) / 2).any():
        raise expected.refusal(
            f"the dark and bright constant patterns are not both found: {why}; {remedy(reasons.values())}"
        )
    measured = expected.program.measured
    measured = measured[measured < shown]
    share = float(np.isin(measured, list(looks)).mean()) if measured.size else 0.0
    if share < MIN_SHARE:
        raise expected.refusal(
            f"only {share:.0%} of the patterns are found: {why}; {remedy(reasons.values())}"
        )


def _summary(record: Mapping[str, Any], kept: int, count: int) -> str:
    return (
        f"{record['frames']} frames: {kept} of {count} patterns found, {record['kept']} frames kept; the first pattern "
        f"begins at {record['first_pattern_seconds']} s, {record['patterns_per_second']} a second"
    )


def _by_reason(reasons: Mapping[int, Reason]) -> list[str]:
    """One line for each reason, with the patterns that it applies to as ranges."""
    return [
        f"no frame of pattern{'s' * (len(numbers) > 1)} {ranges(numbers)}: {reason}"
        for numbers, reason in by_reason(reasons)
    ]
