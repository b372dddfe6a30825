"""A recording by small signatures of its frames: where it stands still, and where something changes.

It is cut into *plateaus*, runs of frames that look alike, by *events*, in which frame after frame is another.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Integers = NDArray[np.intp]

MOST_FRAMES = 64
"""That go into one mean: more make it no better than the video's compression allows."""
_LOUD = 0.98  # quantile of the changes between frames that no noise is as large as
_QUIET = 0.2  # quantile of the changes between frames that is noise alone
_CHANGE = 5.0  # times the noise: an event
_LEAST_CHANGE = 0.6  # codes
_LEAST_SHARE = 0.015  # of the large changes: what a codec adds to a picture after it has come
_CLEAN = 3.0  # times the plateaus' own spread: a frame that is not torn
_LEAST_CLEAN = 0.3  # codes


class Event(NamedTuple):
    """Frames ``first`` and ``last`` look different, and each of those between from its neighbours."""

    first: int
    last: int


class Recording:
    """A recording by its frames' signatures.

    Parameters
    ----------
    signatures : (frames, rows, columns, 3) uint8
    times : (frames,) float64
        Seconds, ascending.
    hold : float
        Seconds that a pattern is shown, about.

    Attributes
    ----------
    events : list of Event
        In the order of time; before, between and after them are the plateaus.
    noise : (frames - 1,) float64
        Root of the mean square of the change between two frames in the noisiest row, where nothing changes, in codes.
    """

    def __init__(self, signatures: NDArray[np.uint8], times: Doubles, hold: float) -> None:
        self.signatures, self.times = signatures, times
        change = np.array([difference(*signatures[t : t + 2]).max() for t in range(len(times) - 1)])
        self.noise = _quiet(change, times, hold)
        large = _LEAST_SHARE * float(np.quantile(change, _LOUD)) if change.size else 0.0
        limit = np.maximum(_CHANGE * self.noise, max(_LEAST_CHANGE, large))
        busy = change > limit
        edges = np.flatnonzero(np.diff(np.concatenate([[False], busy, [False]]).astype(np.int8)))
        events = [Event(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
        # A key frame may change the noise of all at once: what looks the same before and after was no change.
        self.events: list[Event] = []
        for n, event in enumerate(events):
            before = range(self.events[-1].last if self.events else 0, event.first + 1)
            after = range(event.last, (events[n + 1].first if n + 1 < len(events) else len(times) - 1) + 1)
            gap = difference(self.look(before[-5:]), self.look(after[:5])).max()
            if gap > limit[event.first : event.last].max():
                self.events.append(event)

    def plateau(self, n: int) -> range:
        """The frames between events n - 1 and n."""
        first = self.events[n - 1].last if n > 0 else 0
        last = self.events[n].first if n < len(self.events) else len(self.times) - 1
        return range(first, last + 1)

    def look(self, frames: Integers | range) -> Doubles:
        """(rows, columns, 3) float64: the median signature of frames, of some of them if they are many."""
        chosen = np.array(frames)[:: -(-len(frames) // MOST_FRAMES)]
        return np.asarray(np.median(self.signatures[chosen], axis=0), np.float64)

    def clean(self, frames: range) -> tuple[Integers, Doubles]:
        """The frames of a plateau that are like its median in every row, and their weights."""
        chosen = np.array(frames)[:: -(-len(frames) // MOST_FRAMES)]
        middle = self.look(chosen)
        off = np.array([difference(self.signatures[t], middle).max() for t in chosen])
        spread = max(float(np.median(off)), _LEAST_CLEAN)
        kept = off <= _CLEAN * spread
        return chosen[kept], 1 / (1 + (off[kept] / spread) ** 2)


def difference(one: NDArray[np.generic], other: NDArray[np.generic]) -> Doubles:
    """(rows,) float64: root of the mean square of the difference of two signatures in each row."""
    squares = np.subtract(one, other, dtype=np.float64) ** 2
    return np.asarray(np.sqrt(squares.mean(axis=(1, 2))))


def _quiet(change: Doubles, times: Doubles, hold: float) -> Doubles:
    """The changes between frames that are noise alone: a low quantile of those within half a hold.

    The noise of a dark picture is another than that of a bright one.
    """
    middle = (times[1:] + times[:-1]) / 2
    first, last = (
        np.searchsorted(middle, middle - hold / 2),
        np.searchsorted(middle, middle + hold / 2, "right"),
    )
    noise = np.array([np.quantile(change[a:b], _QUIET) for a, b in zip(first, last, strict=True)])
    # What a codec leaves as it was has no noise at all for a while.
    return np.asarray(np.maximum(noise, np.median(noise) / 2 if noise.size else 0))
