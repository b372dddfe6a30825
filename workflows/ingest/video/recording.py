"""Where a recording stands still, and where it changes, from small signatures of its frames.

*Events*, in which every frame differs from the one before, divide a recording into *plateaus*, runs of frames that look
alike.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Integers = NDArray[np.intp]

MAX_FRAMES = 64
"""The most frames that go into one mean. Compression noise remains however many there are."""
_LOUD = 0.98  # this quantile of the changes between frames is larger than any noise
_QUIET = 0.2  # this quantile of the changes between frames is noise alone
_CHANGE = 5.0  # an event is a change of at least so many times the noise,
_LEAST_CHANGE = 0.6  # of so many codes,
_LEAST_SHARE = 0.015  # and of this share of the large changes: codecs refine a picture after it appears
_CLEAN = 3.0  # a frame is not torn if it is off by at most so many times the plateau's own spread,
_LEAST_CLEAN = 0.3  # and the spread is taken for at least so many codes
# A plateau whose brightness, in codes, runs one way by this share is one whose exposure settles: only its frames within
# this share of the end are used.
_DRIFTS, _SETTLED = 0.05, 0.02
_AT_ONCE = 256  # frames that are compared at a time
_ONE_WAY = 1.5  # brightness runs one way if its changes add up to no more than so many times the whole change


class Event(NamedTuple):
    """A change from frame ``first`` to frame ``last``; each frame between differs from its neighbours."""

    first: int
    last: int


class Changes(NamedTuple):
    """What changes from each frame to the next, and how much of it is noise.

    Attributes
    ----------
    change, noise : (n,) float64
        Root mean square over the row where it is largest, in codes.
    """

    change: Doubles
    noise: Doubles


NO_CHANGES = Changes(np.zeros(0), np.zeros(0))


class Recording:
    """The events and plateaus of a recording, or of a part of one.

    Parameters
    ----------
    signatures : (frames, rows, columns, 3) uint8
    times : (frames,) float64
        Seconds, ascending.
    hold : float
        About how long a pattern is shown, in seconds.
    earlier : Changes, optional
        Those of the frames before the part. They too tell how large changes and how much noise is usual.

    Attributes
    ----------
    change : (frames - 1,) float64
        As of `Changes`.
    events : list of Event
        In the order of time; the plateaus lie before, between and after them.
    noise : (frames - 1,) float64
        Change between two frames while nothing changes: root mean square over the noisiest row, in codes.
    """

    def __init__(
        self, signatures: NDArray[np.uint8], times: Doubles, hold: float, earlier: Changes = NO_CHANGES
    ) -> None:
        self.signatures, self.times = signatures, times
        ones, others = signatures[:-1], signatures[1:]
        parts = [slice(at, at + _AT_ONCE) for at in range(0, max(len(ones), 1), _AT_ONCE)]
        self.change = np.concatenate([difference(ones[part], others[part]).max(axis=1) for part in parts])
        self.noise = _quiet(self.change, times, hold, earlier.noise)
        every = np.concatenate([earlier.change, self.change])
        large = _LEAST_SHARE * float(np.quantile(every, _LOUD)) if every.size else 0.0
        limit = np.maximum(_CHANGE * self.noise, max(_LEAST_CHANGE, large))
        busy = self.change > limit
        edges = np.flatnonzero(np.diff(np.concatenate([[False], busy, [False]]).astype(np.int8)))
        events = [Event(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
        # A key frame may change the noise everywhere: what looks the same before and after is not an event.
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
        """The median signature of frames, or of evenly chosen ones if there are many: (rows, columns, 3) float64."""
        chosen = np.array(frames)[:: -(-len(frames) // MAX_FRAMES)]
        return np.asarray(np.median(self.signatures[chosen], axis=0), np.float64)

    def clean(self, frames: range) -> tuple[Integers, Doubles]:
        """The frames of a plateau that resemble its median in every row, and their weights."""
        frames = self._settled(frames)
        chosen = np.array(frames)[:: -(-len(frames) // MAX_FRAMES)]
        middle = self.look(chosen)
        off = difference(self.signatures[chosen], middle).max(axis=1)
        spread = max(float(np.median(off)), _LEAST_CLEAN)
        kept = off <= _CLEAN * spread
        return chosen[kept], 1 / (1 + (off[kept] / spread) ** 2)

    def _settled(self, frames: range) -> range:
        """The frames of a plateau without those in which the camera's exposure was still settling."""
        # The first and the last frame may be torn.
        inner = frames[1:-1]
        if len(inner) < 3:
            return frames
        bright = self.signatures[inner.start : inner.stop].mean(axis=(1, 2, 3))
        whole, end = abs(bright[-1] - bright[0]), bright[-1]
        if whole <= _DRIFTS * end or np.abs(np.diff(bright)).sum() > _ONE_WAY * whole:
            return frames
        before = np.flatnonzero(np.abs(bright - end) > _SETTLED * end)
        return range(inner.start + min(int(before[-1]) + 1, len(inner) - 2), frames.stop)


def difference(one: NDArray[np.generic], other: NDArray[np.generic]) -> Doubles:
    """Root mean square of the difference of two signatures, or of pairs of them, in each row, (..., rows) float64."""
    squares = np.subtract(one, other, dtype=np.float64) ** 2
    return np.asarray(np.sqrt(squares.mean(axis=(-2, -1))))


def _quiet(change: Doubles, times: Doubles, hold: float, earlier: Doubles) -> Doubles:
    """The noise at each frame: a low quantile of the changes within half a hold before and after.

    It is local because a dark picture has other noise than a bright one.
    """
    middle = (times[1:] + times[:-1]) / 2
    first, last = (
        np.searchsorted(middle, middle - hold / 2),
        np.searchsorted(middle, middle + hold / 2, "right"),
    )
    noise, count = np.empty(len(change)), last - first
    for size in np.unique(count).tolist():  # all frames but the outer ones, if they come evenly: at once
        at = np.flatnonzero(count == size)
        noise[at] = np.quantile(change[first[at, np.newaxis] + np.arange(size)], _QUIET, axis=1)
    # Where a codec repeats the picture, there is no noise at all for a while.
    every = np.concatenate([earlier, noise])
    return np.asarray(np.maximum(noise, np.median(every) / 2 if every.size else 0))
