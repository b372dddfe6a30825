"""Find the lead-in and the lead-out of a film: black, white, black, white, black before and after the patterns."""

from typing import NamedTuple

import numpy as np

from workflows.ingest.video.recording import Event, Recording
from workflows.programs.border import LEAD_SECONDS

_OFF = 0.15  # seconds that a change may be early or late
_ALIKE = 0.15  # largest difference of two blacks, or two whites, as a share of that between black and white


class PatternSpan(NamedTuple):
    """The part of a recording that shows the patterns.

    Attributes
    ----------
    frames : slice
        From the black before the first pattern until the black after the last one.
    first : int or None
        Index among them of the first pattern's first frame; None if the lead-in was not found.
    ends : bool
        Whether the lead-out was found.
    """

    frames: slice
    first: int | None
    ends: bool


def find_patterns(recording: Recording) -> PatternSpan:
    """Find the patterns between the lead-in and the lead-out.

    Parameters
    ----------
    recording : Recording
        Of a program shown as by `workflows.programs.border.schedule`.

    Returns
    -------
    PatternSpan
        All of the recording if neither is found.

    Notes
    -----
    The first pattern may be black like the end of the lead-in, so that no change shows when it begins. It begins
    ``LEAD_SECONDS[-1]`` after the last white.
    """
    times, events = recording.times, recording.events
    middle = np.array([(times[event.first] + times[event.last]) / 2 for event in events])
    leads = [n for n in range(len(events) - 3) if _is_lead(recording, middle, n)]
    start, stop, first = 0, len(times), None
    ends = len(leads) > 1 and bool(
        middle[leads[-1]] - LEAD_SECONDS[0] > middle[leads[0] + 3] + LEAD_SECONDS[-1]
    )
    if leads and (ends or leads[0] < len(events) // 2):
        begin = middle[leads[0] + 3] + LEAD_SECONDS[-1]
        start = events[leads[0] + 3].last
        first = int(np.searchsorted(times, begin)) - start
    if ends:
        stop = int(np.searchsorted(times, middle[leads[-1]] - LEAD_SECONDS[0] / 2))
    return PatternSpan(slice(start, stop), first, ends)


def begin_at(recording: Recording, first: int) -> None:
    """Replace all events up to frame ``first`` by one at which the first pattern begins."""
    recording.events = [event for event in recording.events if event.first > first]
    recording.events.insert(0, Event(max(first - 1, 0), first))


def _is_lead(recording: Recording, middle: np.ndarray, n: int) -> bool:
    """Whether events n to n + 3 are those of a lead-in or a lead-out."""
    if np.any(np.abs(np.diff(middle[n : n + 4]) - LEAD_SECONDS[1:4]) > _OFF):
        return False
    looks = [
        recording.look(recording.plateau(at)[-5:] if at == n else recording.plateau(at)[:5])
        for at in range(n, n + 5)
    ]
    (black, white), (again, also), last = looks[:2], looks[2:4], looks[4]
    contrast = np.linalg.norm(white - black)
    off = max(np.linalg.norm(other - black) for other in (again, last))
    return bool(white.mean() > black.mean() and max(off, np.linalg.norm(also - white)) < _ALIKE * contrast)
