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


def take_signatures(
    clip: Clip, max_bytes: int, every: float = math.inf
) -> tuple[Signatures, NDArray[np.int64], LargeFrames]:
    """The signature and the time, in ticks, of every frame, and some large frames. This reads all frames of the clip.

    Parameters
    ----------
    clip : Clip
    max_bytes : int
        Bytes that the signatures and large frames may take.
    every : float
        Seconds between large frames; infinite for none.

    Raises
    ------
    CaptureError
        If they take more than ``max_bytes``, or the frames change their size.
    """
    (columns, rows), (across, down) = (np.minimum(grid, clip.size).tolist() for grid in (CELLS, LARGE_CELLS))
    found, ticks = [], []
    large: dict[int, NDArray[np.uint8]] = {}
    # One for all frames: setting it up takes as long as a frame.
    small, middle = VideoReformatter(), VideoReformatter()
    step, due = every / clip.tick, -math.inf
    for number, frame in enumerate(clip.frames()):
        found.append(_pixels(small.reformat(frame, columns, rows, "rgb24", interpolation=Interpolation.AREA)))
        ticks.append(tick_of(frame))
        if step < math.inf and ticks[-1] >= due:
            due = ticks[-1] + step
            large[number] = _pixels(
                middle.reformat(frame, across, down, "gray", interpolation=Interpolation.AREA)
            )
        if len(found) * found[0].nbytes + len(large) * across * down > max_bytes:
            raise CaptureError(
                f"{clip.entry} has more than {len(found)} frames, the most that can be matched to patterns: cut off "
                "what was recorded before and after the program",
                entry=clip.entry,
                limit=len(found),
            )
    grey = np.array(list(large.values()), np.uint8).reshape(-1, down, across)
    return np.stack(found), np.array(ticks, np.int64), LargeFrames(grey, np.array(list(large), np.intp))


def _pixels(frame: VideoFrame) -> NDArray[np.uint8]:
    pixels: NDArray[np.uint8] = np.asarray(frame.to_ndarray(), np.uint8)
    return pixels
