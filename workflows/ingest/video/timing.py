"""The frames of each pattern of a program, found by the times of the changes in a recording."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from workflows.ingest.video.boundaries import ENOUGH, JITTER, Bools, Edge, Step, shortest_path
from workflows.ingest.video.missing_patterns import Reason
from workflows.ingest.video.recording import Doubles, Integers, Recording

_UNLIKELY = 3.5  # standard deviations
_SLACK = 0.2  # of a pattern's time: how far off the time of an event may be where something moves


@dataclass(frozen=True)
class FoundPatterns:
    """The frames of each pattern in a recording.

    Attributes
    ----------
    frames : list of (k,) intp
        Clean frames of each pattern, in the order of time; empty if the pattern was not found.
    weights : list of (k,) float64
        How much each of them counts.
    reasons : dict of int to Reason
        Why a pattern has no frames.
    start, rate : float
        Seconds from the first frame to the first pattern, and patterns a second.
    cost : float
        Negative log likelihood of the timing, up to a constant.
    jumps : bool
        Whether there was not enough time somewhere for the patterns that must have passed: part of the recording is
        cut out, or the match is wrong.
    longer : int
        Patterns of the program that was shown, at least, if its border numbers more of them than there should be.
    """

    frames: list[Integers]
    weights: list[Doubles]
    reasons: dict[int, Reason]
    start: float
    rate: float
    cost: float
    jumps: bool
    longer: int = 0


def find_by_timing(
    recording: Recording, rate: float, same: Bools, begin: Edge, end: Edge
) -> FoundPatterns | None:
    """Find the frames of each pattern by the times of the changes.

    Parameters
    ----------
    recording : Recording
    rate : float
        About how many patterns were shown in a second.
    same : (n - 1,) bool
        Whether a pattern is the same picture as the one before it.
    begin, end : Edge
        How the first pattern begins, and how the last one ends.

    Returns
    -------
    FoundPatterns or None
        None if n patterns do not fit the events.
    """
    path = shortest_path(recording, 1 / rate, same, begin, end)
    if path is None:
        return None
    hold = _hold(path[0], 1 / rate)
    if abs(hold * rate - 1) > 0.02:
        path = shortest_path(recording, hold, same, begin, end) or path
        hold = _hold(path[0], hold)
    steps, cost = path
    frames: list[Integers] = [np.zeros(0, np.intp)] * (len(same) + 1)
    weights: list[Doubles] = [np.zeros(0)] * (len(same) + 1)
    reasons: dict[int, Reason] = {}
    for pattern, given in _frames_of(recording, steps, hold, same).items():
        if isinstance(given, Reason):
            reasons[pattern] = given
        else:
            frames[pattern], weights[pattern] = recording.clean(given)
    start = steps[0].begin - steps[0].first * hold - float(recording.times[0])
    return FoundPatterns(frames, weights, reasons, start, 1 / hold, cost, _jumps(steps, hold))


def _jumps(steps: list[Step], hold: float) -> bool:
    """Whether several boundaries lie where there is time for fewer."""
    for a, b in pairwise(steps):
        holds, disturbed = b.first - a.last, b.event > a.event + 1
        least = holds - _UNLIKELY * JITTER * math.sqrt(holds) - _SLACK * disturbed
        if holds > 1 and b.begin - a.end < least * hold:
            return True
    return False


def _hold(steps: list[Step], about: float) -> float:
    """The median time between successive boundaries, in seconds."""
    times = [b.begin - a.end for a, b in pairwise(steps) if b.first == a.last + 1 and b.event == a.event + 1]
    return float(np.median(times)) if times else about


def _frames_of(
    recording: Recording, steps: list[Step], hold: float, same: Bools
) -> dict[int, range | Reason]:
    """The frames between the boundaries of each pattern, or why there are none."""
    n, times = len(same) + 1, recording.times
    found: dict[int, range | Reason] = {}

    def within(plateau: range, begin: float, end: float) -> range:
        return range(*np.clip(np.searchsorted(times, [begin, end]), plateau.start, plateau.stop).tolist())

    first, last = steps[0], steps[-1]
    for pattern in range(first.first):
        found[pattern] = Reason.BEFORE
    if first.first > 0:  # at the end of what the monitor showed before
        plateau = recording.plateau(first.event)
        found[first.first - 1] = within(plateau, first.begin - ENOUGH * hold, first.begin)
    for step in steps:
        for pattern in range(step.first, step.last):
            found[pattern] = Reason.SHORT
    for a, b in pairwise(steps):
        head, tail = recording.plateau(a.event + 1), recording.plateau(b.event)
        undisturbed = b.event == a.event + 1
        if b.first == a.last + 1:
            found[a.last] = head if undisturbed else _alike(recording, range(a.event + 1, b.event + 1))
            continue
        share = (b.begin - a.end) / (b.first - a.last)
        for pattern in range(a.last, b.first):
            if undisturbed and same[a.last : b.first - 1].all():
                begin = a.end + (pattern - a.last) * share
                found[pattern] = within(head, begin + 0.2 * share, begin + 0.8 * share)
            else:
                found[pattern] = Reason.UNCLEAR
        if not undisturbed:
            for pattern, plateau in ((a.last, head), (b.first - 1, tail)):
                if times[plateau[-1]] - times[plateau[0]] < hold * (1 + 3 * JITTER):
                    found[pattern] = plateau
    for pattern in range(last.last, n):
        found[pattern] = Reason.AFTER
    if last.last < n:
        plateau = recording.plateau(last.event + 1)
        found[last.last] = within(plateau, last.end, last.end + ENOUGH * hold)
    return {
        # A single frame may be torn: there is none to compare it with.
        pattern: Reason.TORN if isinstance(given, range) and len(given) < 2 else given
        for pattern, given in sorted(found.items())
    }


def _alike(recording: Recording, plateaus: range) -> range | Reason:
    """The longest of several plateaus of one pattern, if it has most of their frames."""
    longest = max((recording.plateau(n) for n in plateaus), key=len)
    if 2 * len(longest) > sum(len(recording.plateau(n)) for n in plateaus):
        return longest
    return Reason.DISTURBED
