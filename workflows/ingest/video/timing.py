"""Which frames of a recording show which pattern of a program: the changes between frames against the known timing.

Each beginning of a pattern, and the end of the last one, is a *boundary*: it lies in an event of the recording, unless
what came before looks the same. A shortest path finds the boundaries that fit the timing best, all of them between the
first and the last.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.ingest.video.missing_patterns import Reason
from workflows.ingest.video.recording import Doubles, Integers, Recording

Bools = NDArray[np.bool_]

Edge = Literal["seen", "hidden", "cut"]
"""How the program begins or ends: with a change; unseen, for the monitor shows the same before or after; or it does so
before the recording begins, or after it has ended."""

JITTER = 0.1
"""Of a pattern's hold, in units of itself: standard deviation."""
# Costs in units of -ln likelihood.
_HIDDEN = 12.0  # a boundary that no event shows, between patterns that differ
_SAME = 0.5  # the same, between patterns that do not
_JUNK = 8.0  # an event that is no boundary
_JUNK_OUTSIDE = 3.0  # the same, before the program and after it
_MOST_JUNK = 24
_EDGE = {"seen": 0.0, "hidden": 6.0, "cut": 40.0}
_AT_EDGE = {
    "seen": slice(0, 1),
    "hidden": slice(1, 2),
    "cut": slice(1, None),
}  # boundaries, from an end of the program
_ENOUGH = 0.7  # of a hold: what is surely the pattern's
_UNLIKELY = 3.5  # standard deviations
_SLACK = 0.2  # of a hold: how far the time of an event may be off where something moves
_ELBOW = 4.0  # standard deviations from which on timing costs less


@dataclass(frozen=True)
class Found:
    """What a recording shows of a program.

    Attributes
    ----------
    frames : list of (k,) intp
        Clean frames of each pattern, in the order of time; none where the pattern was not found.
    weights : list of (k,) float64
        How much each of them is to count.
    reasons : dict of int to Reason
        Why a pattern has no frames.
    start, rate : float
        Seconds from the first frame to the first pattern, and patterns a second.
    cost : float
        -ln likelihood of the timing, but for a constant.
    jumps : bool
        Whether more patterns must have passed somewhere than there was time for: something is cut out, or all is wrong.
    """

    frames: list[Integers]
    weights: list[Doubles]
    reasons: dict[int, Reason]
    start: float
    rate: float
    cost: float
    jumps: bool


class Step(NamedTuple):
    """An event that holds boundaries ``first`` to ``last``: the first at ``begin``, the last at ``end``, in seconds."""

    event: int
    first: int
    last: int
    begin: float
    end: float


class _Option(NamedTuple):
    """A number of boundaries that an event may hold, and what is known of when the first and the last of them are."""

    event: int
    boundaries: int
    begin: float
    end: float
    variance: float
    cost: float


def find(recording: Recording, rate: float, same: Bools, begin: Edge, end: Edge) -> Found | None:
    """Find the frames of each pattern.

    Parameters
    ----------
    recording : Recording
    rate : float
        Patterns a second, about.
    same : (n - 1,) bool
        Whether a pattern is the same picture as the one before it.
    begin, end : Edge
        How the first pattern begins, and how the last one ends.

    Returns
    -------
    Found or None
        None if no n patterns fit the events.
    """
    path = _shortest(recording, 1 / rate, same, begin, end)
    if path is None:
        return None
    hold = _hold(path[0], 1 / rate)
    if abs(hold * rate - 1) > 0.02:
        path = _shortest(recording, hold, same, begin, end) or path
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
    return Found(frames, weights, reasons, start, 1 / hold, cost, _jumps(steps, hold))


def _jumps(steps: list[Step], hold: float) -> bool:
    """Whether more than one boundary lies somewhere where there is time for fewer."""
    for a, b in pairwise(steps):
        holds, disturbed = b.first - a.last, b.event > a.event + 1
        least = holds - _UNLIKELY * JITTER * math.sqrt(holds) - _SLACK * disturbed
        if holds > 1 and b.begin - a.end < least * hold:
            return True
    return False


def _hold(steps: list[Step], about: float) -> float:
    """The median time between boundaries that follow one another."""
    times = [b.begin - a.end for a, b in pairwise(steps) if b.first == a.last + 1 and b.event == a.event + 1]
    return float(np.median(times)) if times else about


def _options(recording: Recording, hold: float) -> list[_Option]:
    """What each event may hold: one boundary, or as many as there is time for in a long one."""
    times = recording.times
    spans = [float(times[event.last] - times[event.first]) for event in recording.events]
    usual = float(np.median(spans)) if spans else 0.0
    options = []
    for n, (event, span) in enumerate(zip(recording.events, spans, strict=True)):
        whole = (span - usual) / hold
        for count in range(1, 1 + max(1, 2 + math.floor(whole + 0.3))):
            if count < whole - 1:
                continue
            slack = span - usual - (count - 1) * hold
            short, free = max(-slack, 0) / hold, max(slack, 0)
            if count > 1 and short > 0.6:
                continue
            options.append(
                _Option(
                    n,
                    count,
                    float(times[event.first]) + min(usual, span) / 2 + free / 2,
                    float(times[event.last]) - min(usual, span) / 2 - free / 2,
                    (free**2 + (usual / 2) ** 2) / 12,
                    2.0 * (count - 1) + (short / JITTER) ** 2 / 2,
                )
            )
    return options


def _shortest(
    recording: Recording, hold: float, same: Bools, begin: Edge, end: Edge
) -> tuple[list[Step], float] | None:
    """The boundaries' path through the events that costs least, and its cost."""
    n, times, options = len(same) + 1, recording.times, _options(recording, hold)
    hidden = np.concatenate([[0, 0], np.cumsum(np.where(same, _SAME, _HIDDEN)), [np.inf]])  # up to a boundary
    cost = np.full((len(options), n + 1), np.inf)
    before = np.full((len(options), n + 1, 2), -1, np.int32)
    begins = np.searchsorted([option.event for option in options], range(len(recording.events)))
    for at, option in enumerate(options):
        entry = np.full(n + 1, np.inf)  # as the first event that holds a boundary
        if _fits(begin, option.begin - times[0], hold, outside=option.event):
            entry[_AT_EDGE[begin]] = _EDGE[begin]
        more = option.boundaries - 1
        cost[at, more:] = entry[: n + 1 - more] + option.cost + _JUNK_OUTSIDE * option.event
        for event in range(option.event - 1, max(option.event - _MOST_JUNK, 0) - 1, -1):
            junk = option.event - event - 1
            last = begins[event + 1] if event + 1 < len(begins) else len(options)
            for earlier in range(begins[event], last):
                elapsed = option.begin - options[earlier].end
                around = max(elapsed, 0.0) / hold
                wide = math.ceil(1 + 3 * JITTER * math.sqrt(around))
                for step in range(max(1, round(around) - wide), round(around) + wide + 1):
                    to = step + more
                    if to > n:
                        break
                    variance = options[earlier].variance + option.variance
                    price = _late(elapsed - step * hold, hold, step, variance) + option.cost
                    price += _JUNK * min(junk, 3) + max(junk - 3, 0)
                    unseen = hidden[step : n + 1 - more] - hidden[1 : n + 2 - more - step]
                    tried = cost[earlier, : n + 1 - to] + price + unseen
                    better = tried < cost[at, to:]
                    cost[at, to:][better] = tried[better]
                    before[at, to:][better] = np.stack(
                        [np.full(n + 1 - to, earlier), np.arange(n + 1 - to)], 1
                    )[better]
    ends = cost + np.array([_JUNK_OUTSIDE * (len(recording.events) - 1 - o.event) for o in options])[:, None]
    for at, option in enumerate(options):
        outside = len(recording.events) - 1 - option.event
        leave = np.full(n + 1, np.inf)
        if _fits(end, times[-1] - option.end, hold, outside):
            leave[::-1][_AT_EDGE[end]] = _EDGE[end]
        ends[at] += leave
    if not np.isfinite(ends).any():
        return None
    at, index = (int(i) for i in np.unravel_index(np.argmin(ends), ends.shape))
    steps, least = [], float(ends[at, index])
    while at >= 0:
        option = options[at]
        steps.append(Step(option.event, index - option.boundaries + 1, index, option.begin, option.end))
        at, index = (int(i) for i in before[at, index])
    return steps[::-1], least


def _fits(edge: Edge, time: float, hold: float, outside: int) -> bool:
    """Whether there is time for an edge of the program between an event and an end of the recording."""
    if edge == "hidden":
        return time > _ENOUGH * hold
    # Who cut the recording left no more of it than of a pattern: what stands still for longer is no pattern.
    return edge == "seen" or (outside == 0 and time < (1 + 3 * JITTER) * hold)


def _late(late: float, hold: float, holds: int, variance: float) -> float:
    """-ln likelihood of so many holds ending so late."""
    own = JITTER * hold
    spread = math.sqrt(own**2 * holds + variance)
    z = abs(late) / spread
    return (z**2 / 2 if z < _ELBOW else _ELBOW * (z - _ELBOW / 2)) + math.log(spread / own)


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
    if first.first > 0:  # the end of what the monitor showed before
        plateau = recording.plateau(first.event)
        found[first.first - 1] = within(plateau, first.begin - _ENOUGH * hold, first.begin)
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
        found[last.last] = within(plateau, last.end, last.end + _ENOUGH * hold)
    return {
        # One frame alone may be torn: it has none to be compared with.
        pattern: Reason.TORN if isinstance(given, range) and len(given) < 2 else given
        for pattern, given in sorted(found.items())
    }


def _alike(recording: Recording, plateaus: range) -> range | Reason:
    """The longest of the plateaus of one pattern, if it holds most of their frames."""
    longest = max((recording.plateau(n) for n in plateaus), key=len)
    if 2 * len(longest) > sum(len(recording.plateau(n)) for n in plateaus):
        return longest
    return Reason.DISTURBED
