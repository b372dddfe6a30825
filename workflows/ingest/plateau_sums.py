"""Sums of a film's frames that are made while its patterns are found, so that most frames are decoded only once.

Which frames show a pattern is known when all of the film has been read. But those that look alike are added up as soon
as they have passed. Where they turn out to be the frames of a pattern, with the same weights, its mean is that of their
sum.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import BinaryIO, NamedTuple

import numpy as np
from av.video.format import VideoFormat
from av.video.frame import VideoFrame
from numpy.typing import NDArray

from workflows.ingest.video.clip import Clip, tick_of
from workflows.ingest.video.frame_means import FrameSum, Look, Share, add_up, shares_of
from workflows.ingest.video.recording import NO_CHANGES, Changes, Recording

EVERY = 0.5
"""How often plateaus are looked for, in holds."""
AROUND = 0.5
"""Holds before and after an event that `Recording` needs to tell it from noise."""
LONGEST = 3.0
"""Holds that a frame waits, at most."""


class _Seen(NamedTuple):
    tick: int
    signature: NDArray[np.uint8]


class PlateauSums:
    """Adds up the frames of each plateau of a film once it has ended.

    Parameters
    ----------
    clip : Clip
    hold : float
        About how long a pattern is shown, in seconds.
    memory : int
        Bytes that waiting frames may take. Longer plateaus have no sum.
    """

    def __init__(self, clip: Clip, hold: float, memory: int) -> None:
        self._clip, self._hold, self._memory = clip, hold / clip.tick, memory
        self._seen: list[_Seen] = []
        self._earlier = NO_CHANGES
        self._waiting: dict[int, VideoFrame] = {}
        self._due = -np.inf

    def add(self, frame: VideoFrame, signature: NDArray[np.uint8]) -> Iterator[tuple[list[Share], FrameSum]]:
        """Take the next frame; yields the plateaus that have ended, as the frames with their weights, and their sum."""
        tick = tick_of(frame)
        self._seen.append(_Seen(tick, signature))
        self._waiting[tick] = frame
        most = self._memory // sum(plane.buffer_size for plane in frame.planes)
        oldest = next(iter(self._waiting))
        while len(self._waiting) > most or tick - oldest > LONGEST * self._hold:
            del self._waiting[oldest]
            oldest = next(iter(self._waiting), tick)
        if tick >= self._due:
            self._due = tick + EVERY * self._hold
            yield from self._ended(oldest)

    def _ended(self, begin: int) -> Iterator[tuple[list[Share], FrameSum]]:
        """The plateaus between events that no later frame makes uncertain, if all frames from ``begin`` on wait."""
        ticks = np.array([seen.tick for seen in self._seen])
        times = (ticks - ticks[0]) * self._clip.tick
        signatures = np.stack([seen.signature for seen in self._seen])
        recording = Recording(signatures, times, self._hold * self._clip.tick, self._earlier)
        until = ticks[-1] - AROUND * self._hold
        events = [event for event in recording.events if ticks[event.last] < until]
        for n in range(1, len(events)):
            frames, weights = recording.clean(recording.plateau(n))
            shares = shares_of(ticks[frames], weights)
            if all(share.tick in self._waiting for share in shares):
                some = ((self._waiting[tick], weight) for tick, weight in shares)
                yield shares, add_up(some, self._clip.quarter_turns)
        if events:
            begin = int(ticks[events[-1].last])
            self._waiting = {tick: frame for tick, frame in self._waiting.items() if tick >= begin}
        past = int(np.searchsorted(ticks, begin - AROUND * self._hold))
        self._seen = self._seen[past:]
        self._earlier = Changes(
            np.concatenate([self._earlier.change, recording.change[:past]]),
            np.concatenate([self._earlier.noise, recording.noise[:past]]),
        )


def name_of(shares: Sequence[Share]) -> str:
    """A name for the sum of these frames with these weights, and no other."""
    return hashlib.sha256(json.dumps(shares).encode()).hexdigest()[:32]


def to_bytes(total: FrameSum) -> NDArray[np.uint8]:
    """A sum as it is kept: a line of JSON, then the planes."""
    head = np.frombuffer(json.dumps(total.look).encode() + b"\n", np.uint8)
    return np.concatenate([head, *(plane.reshape(-1).view(np.uint8) for plane in total.planes)])


def from_bytes(file: BinaryIO) -> FrameSum:
    """The sum that `to_bytes` has written."""
    look = Look(*json.loads(file.readline()))
    values = VideoFrame(look.width, look.height, look.format)
    kind = np.dtype("u2" if VideoFormat(look.format).components[0].bits == 8 else "u4")
    planes = [
        np.frombuffer(file.read(plane.height * plane.width * kind.itemsize), kind).reshape(
            plane.height, plane.width
        )
        for plane in values.planes
    ]
    return FrameSum(planes, look)
