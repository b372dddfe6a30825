"""Small copies of a video's frames, from which the frames of each pattern are found."""

import math
from typing import NamedTuple

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from numpy.typing import NDArray

from storage.errors import CaptureError
from workflows.ingest.video.clip import Clip, tick_of

CELLS = (32, 24)
"""Columns and rows of a signature."""
LARGE_CELLS = (128, 96)
"""Columns and rows of a large frame, on which the cells of a border are distinct."""

Signatures = NDArray[np.uint8]
"""(frames, rows, columns, 3) uint8: mean RGB codes over each cell of a grid, before rotation."""
Signature = NDArray[np.uint8]
"""(rows, columns, 3) uint8: one of them."""


class LargeFrames(NamedTuple):
    """Some frames of a recording, large enough to show the cells of a border.

    Attributes
    ----------
    grey : (k, rows, columns) uint8
        Luma, before rotation.
    frames : (k,) intp
        Their indices in the recording, ascending.
    """

    grey: NDArray[np.uint8]
    frames: NDArray[np.intp]


class SmallCopies:
    """The signatures of all frames of a clip, and some large frames.

    Parameters
    ----------
    clip : Clip
    max_bytes : int
        Bytes that the signatures and large frames may take.
    every : float
        Seconds between large frames; infinite for none.
    """

    def __init__(self, clip: Clip, max_bytes: int, every: float = math.inf) -> None:
        self._entry, self._max_bytes, self._step = clip.entry, max_bytes, every / clip.tick
        (self._columns, self._rows), (self._across, self._down) = (
            np.minimum(grid, clip.size).tolist() for grid in (CELLS, LARGE_CELLS)
        )
        self._found: list[Signature] = []
        self._ticks: list[int] = []
        self._large: dict[int, NDArray[np.uint8]] = {}
        self._due = -math.inf
        # One for all frames: setting it up takes as long as a frame.
        self._small, self._middle = VideoReformatter(), VideoReformatter()

    def add(self, frame: VideoFrame) -> Signature:
        """Take the next frame; returns its signature.

        Raises
        ------
        CaptureError
            If there are more than ``max_bytes`` of them.
        """
        signature = _pixels(
            self._small.reformat(frame, self._columns, self._rows, "rgb24", interpolation=Interpolation.AREA)
        )
        tick = tick_of(frame)
        if self._step < math.inf and tick >= self._due:
            self._due = tick + self._step
            self._large[len(self._found)] = _pixels(
                self._middle.reformat(
                    frame, self._across, self._down, "gray", interpolation=Interpolation.AREA
                )
            )
        self._found.append(signature)
        self._ticks.append(tick)
        count = len(self._found)
        if count * signature.nbytes + len(self._large) * self._across * self._down > self._max_bytes:
            raise CaptureError(
                f"{self._entry} has more than {count} frames, the most that can be matched to patterns: cut off "
                "what was recorded before and after the program",
                entry=self._entry,
                limit=count,
            )
        return signature

    def taken(self) -> tuple[Signatures, NDArray[np.int64], LargeFrames]:
        """The signature and the time, in ticks, of every frame, and the large frames."""
        grey = np.array(list(self._large.values()), np.uint8).reshape(-1, self._down, self._across)
        large = LargeFrames(grey, np.array(list(self._large), np.intp))
        return np.stack(self._found), np.array(self._ticks, np.int64), large


def _pixels(frame: VideoFrame) -> NDArray[np.uint8]:
    pixels: NDArray[np.uint8] = np.asarray(frame.to_ndarray(), np.uint8)
    return pixels
