"""Where each pattern of a program begins in a recording: a shortest path through the recording's events.

The beginning of each pattern, and the end of the last one, is a *boundary*. Between the first and the last, every
boundary lies in an event of the recording, unless the pattern looks the same as the one before it. The path that costs
least fits the known timing of the program best.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from workflows.ingest.video.recording import Recording

Bools = NDArray[np.bool_]

Edge = Literal["seen", "hidden", "cut"]
"""How a program begins or ends: with a change (``seen``), without one because the monitor shows the same picture before
or after it (``hidden``), or outside of the recording (``cut``)."""

JITTER = 0.1
"""Standard deviation of the time that a pattern is shown, relative to that time."""
ENOUGH = 0.7
"""The share of its time for which a pattern is certainly shown."""
# Costs are negative log likelihoods, set by hand: 12 stands for odds of 1 to 160,000.
_HIDDEN = 12.0  # of a boundary without an event, between patterns that differ
_SAME = 0.5  # of a boundary without an event, between patterns that do not
_JUNK, _FIRST_JUNK = 8.0, 3  # of each of the first events without a boundary in succession,
_FURTHER_JUNK = 1.0  # and of each further one: what disturbs goes on
_JUNK_OUTSIDE = 3.0  # of an event before the program or after it
_REACH = 24  # events from one with a boundary to the next, at most
_MORE = 2.0  # of each boundary but one in an event
_EDGE = {"seen": 0.0, "hidden": 6.0, "cut": 40.0}
# Boundaries that may be the first or the last one in an event, counted from that end of the program.
_AT_EDGE = {"seen": slice(0, 1), "hidden": slice(1, 2), "cut": slice(1, None)}
_ELBOW = 4.0  # standard deviations above which the cost of timing grows only linearly
_CERTAIN = 3.0  # standard deviations that no time is off by
_ALMOST = 0.3  # an event may hold a pattern that lacks this share of its time,
_SHORTEST = 0.6  # and patterns that lack this share together


class Step(NamedTuple):
    """An event that holds boundaries ``first`` to ``last``: the first at ``begin``, the last at ``end``, in seconds."""

    event: int
    first: int
    last: int
    begin: float
    end: float


class _Option(NamedTuple):
    """A number of boundaries that an event may hold, when the first and last of them are, and what that costs."""

    event: int
    boundaries: int
    begin: float
    end: float
    variance: float
    cost: float


def shortest_path(
    recording: Recording, hold: float, same: Bools, begin: Edge, end: Edge
) -> tuple[list[Step], float] | None:
    """Find the boundaries that fit the timing of a program best.

    Parameters
    ----------
    recording : Recording
    hold : float
        How long a pattern is shown, in seconds.
    same : (n - 1,) bool
        Whether a pattern is the same picture as the one before it.
    begin, end : Edge
        How the first pattern begins, and how the last one ends.

    Returns
    -------
    (list of Step, float) or None
        The events with boundaries in the order of time, and the cost; None if no path fits.
    """
    options, times = _options(recording, hold), recording.times
    paths = _Paths(options, same)
    of_event = [list(some) for _, some in groupby(range(len(options)), lambda at: options[at].event)]
    for at, option in enumerate(options):
        if _fits(begin, option.begin - times[0], hold, outside=option.event):
            paths.begin(at, begin)
        near = of_event[max(option.event - _REACH, 0) : option.event]
        for earlier in chain.from_iterable(reversed(near)):
            for patterns, price in _prices(options[earlier], option, hold):
                if patterns + option.boundaries - 1 > len(same) + 1:
                    break
                paths.extend(at, earlier, patterns, price)
    ends = np.full_like(paths.cost, np.inf)
    for at, option in enumerate(options):
        outside = len(recording.events) - 1 - option.event
        if _fits(end, times[-1] - option.end, hold, outside):
            ends[at] = paths.ends(at, end, outside)
    if not np.isfinite(ends).any():
        return None
    at, boundary = (int(i) for i in np.unravel_index(np.argmin(ends), ends.shape))
    return paths.back_from(at, boundary), float(ends[at, boundary])


class _Paths:
    """The cheapest path to each boundary, for each option that it may be the last one in.

    Parameters
    ----------
    options : sequence of _Option
    same : (n - 1,) bool
        As of `shortest_path`.

    Attributes
    ----------
    cost : (options, n + 1) float64
        Infinite where there is no path.
    """

    def __init__(self, options: Sequence[_Option], same: Bools) -> None:
        n = len(same) + 1
        self._options = options
        # What it costs to hide all boundaries up to each one; the first and the last are never between others.
        self._hidden = np.concatenate([[0, 0], np.cumsum(np.where(same, _SAME, _HIDDEN)), [np.inf]])
        self.cost = np.full((len(options), n + 1), np.inf)
        # The option and the boundary that a path comes from.
        self._before = np.full((len(options), n + 1, 2), -1, np.int32)

    def begin(self, at: int, edge: Edge) -> None:
        """Begin paths with an option."""
        option, size = self._options[at], self.cost.shape[1]
        entry = np.full(size, np.inf)
        entry[_AT_EDGE[edge]] = _EDGE[edge]
        more = option.boundaries - 1
        self.cost[at, more:] = entry[: size - more] + option.cost + _JUNK_OUTSIDE * option.event

    def extend(self, at: int, earlier: int, patterns: int, price: float) -> None:
        """Go from an earlier option to one whose first boundary is so many patterns later, where that is cheaper."""
        size, more = self.cost.shape[1], self._options[at].boundaries - 1
        to = patterns + more
        unseen = self._hidden[patterns : size - more] - self._hidden[1 : size + 1 - more - patterns]
        tried = self.cost[earlier, : size - to] + price + unseen
        better = tried < self.cost[at, to:]
        self.cost[at, to:][better] = tried[better]
        came_from = np.stack([np.full(size - to, earlier), np.arange(size - to)], axis=1)
        self._before[at, to:][better] = came_from[better]

    def ends(self, at: int, edge: Edge, outside: int) -> NDArray[np.float64]:
        """What paths cost that end with an option, ``outside`` events before the last one, (n + 1,)."""
        leave = np.full(self.cost.shape[1], np.inf)
        leave[::-1][_AT_EDGE[edge]] = _EDGE[edge]
        cost: NDArray[np.float64] = self.cost[at] + _JUNK_OUTSIDE * outside + leave
        return cost

    def back_from(self, at: int, boundary: int) -> list[Step]:
        """The cheapest path to a boundary, from its beginning."""
        steps = []
        while at >= 0:
            option = self._options[at]
            first = boundary - option.boundaries + 1
            steps.append(Step(option.event, first, boundary, option.begin, option.end))
            at, boundary = (int(i) for i in self._before[at, boundary])
        return steps[::-1]


def _prices(earlier: _Option, option: _Option, hold: float) -> Iterator[tuple[int, float]]:
    """How many patterns may be shown from one option to another, ascending, and what each number costs."""
    elapsed = option.begin - earlier.end
    around = max(elapsed, 0.0) / hold
    wide = math.ceil(1 + _CERTAIN * JITTER * math.sqrt(around))
    junk = option.event - earlier.event - 1
    disturbed = _JUNK * min(junk, _FIRST_JUNK) + _FURTHER_JUNK * max(junk - _FIRST_JUNK, 0)
    variance = earlier.variance + option.variance
    for patterns in range(max(1, round(around) - wide), round(around) + wide + 1):
        late = _late(elapsed - patterns * hold, hold, patterns, variance)
        yield patterns, late + option.cost + disturbed


def _options(recording: Recording, hold: float) -> list[_Option]:
    """What each event may hold: one boundary, or in a long event as many as there is time for."""
    times = recording.times
    spans = [float(times[event.last] - times[event.first]) for event in recording.events]
    usual = float(np.median(spans)) if spans else 0.0
    options = []
    for n, (event, span) in enumerate(zip(recording.events, spans, strict=True)):
        whole = (span - usual) / hold
        for count in range(1, 1 + max(1, 2 + math.floor(whole + _ALMOST))):
            if count < whole - 1:
                continue
            slack = span - usual - (count - 1) * hold
            short, free = max(-slack, 0) / hold, max(slack, 0)
            if count > 1 and short > _SHORTEST:
                continue
            options.append(
                _Option(
                    n,
                    count,
                    float(times[event.first]) + min(usual, span) / 2 + free / 2,
                    float(times[event.last]) - min(usual, span) / 2 - free / 2,
                    (free**2 + (usual / 2) ** 2) / 12,
                    _MORE * (count - 1) + (short / JITTER) ** 2 / 2,
                )
            )
    return options


def _fits(edge: Edge, time: float, hold: float, outside: int) -> bool:
    """Whether a program may begin or end so, ``time`` seconds and ``outside`` events from the end of the recording."""
    if edge == "hidden":
        return time > ENOUGH * hold
    # A recording cut within a pattern shows nothing else, and stands still for no longer than a pattern.
    return edge == "seen" or (outside == 0 and time < (1 + _CERTAIN * JITTER) * hold)


def _late(late: float, hold: float, holds: int, variance: float) -> float:
    """Cost of the time that ``holds`` patterns take, together ``late`` seconds longer than expected."""
    own = JITTER * hold
    spread = math.sqrt(own**2 * holds + variance)
    z = abs(late) / spread
    return (z**2 / 2 if z < _ELBOW else _ELBOW * (z - _ELBOW / 2)) + math.log(spread / own)
