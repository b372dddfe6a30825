"""Where each pattern of a program begins in a recording: a shortest path through the recording's events.

The beginning of each pattern, and the end of the last one, is a *boundary*. Between the first and the last, every
boundary lies in an event of the recording, unless the pattern looks the same as the one before it. The path that costs
least fits the known timing of the program best.
"""

import math
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
# Costs are negative log likelihoods.
_HIDDEN = 12.0  # of a boundary without an event, between patterns that differ
_SAME = 0.5  # of a boundary without an event, between patterns that do not
_JUNK = 8.0  # of an event without a boundary
_JUNK_OUTSIDE = 3.0  # of an event before the program or after it
_MAX_JUNK = 24
_EDGE = {"seen": 0.0, "hidden": 6.0, "cut": 40.0}
# Boundaries that may be the first or the last one in an event, counted from that end of the program.
_AT_EDGE = {"seen": slice(0, 1), "hidden": slice(1, 2), "cut": slice(1, None)}
_ELBOW = 4.0  # standard deviations above which the cost of timing grows only linearly


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
    n, times, options = len(same) + 1, recording.times, _options(recording, hold)
    # Cost up to each boundary.
    hidden = np.concatenate([[0, 0], np.cumsum(np.where(same, _SAME, _HIDDEN)), [np.inf]])
    cost = np.full((len(options), n + 1), np.inf)
    before = np.full((len(options), n + 1, 2), -1, np.int32)
    begins = np.searchsorted([option.event for option in options], range(len(recording.events)))
    for at, option in enumerate(options):
        entry = np.full(n + 1, np.inf)  # as the first event with a boundary
        if _fits(begin, option.begin - times[0], hold, outside=option.event):
            entry[_AT_EDGE[begin]] = _EDGE[begin]
        more = option.boundaries - 1
        cost[at, more:] = entry[: n + 1 - more] + option.cost + _JUNK_OUTSIDE * option.event
        for event in range(option.event - 1, max(option.event - _MAX_JUNK, 0) - 1, -1):
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


def _options(recording: Recording, hold: float) -> list[_Option]:
    """What each event may hold: one boundary, or in a long event as many as there is time for."""
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


def _fits(edge: Edge, time: float, hold: float, outside: int) -> bool:
    """Whether a program may begin or end so, ``time`` seconds and ``outside`` events from the end of the recording."""
    if edge == "hidden":
        return time > ENOUGH * hold
    # A recording cut within a pattern shows nothing else, and stands still for no longer than a pattern.
    return edge == "seen" or (outside == 0 and time < (1 + 3 * JITTER) * hold)


def _late(late: float, hold: float, holds: int, variance: float) -> float:
    """Cost of the time that ``holds`` patterns take, together ``late`` seconds longer than expected."""
    own = JITTER * hold
    spread = math.sqrt(own**2 * holds + variance)
    z = abs(late) / spread
    return (z**2 / 2 if z < _ELBOW else _ELBOW * (z - _ELBOW / 2)) + math.log(spread / own)
