"""A video in a bundle: opened as hostile, looked over frame by frame, and averaged."""

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import chain
from typing import Any, BinaryIO, NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation
from av.video.stream import VideoStream
from numpy.typing import NDArray

from storage.errors import CaptureError

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
"""What is probed for. Others, playlists among them, name files and hosts of their own."""
CODECS = frozenset({"h264", "hevc", "mjpeg", "mpeg4", "vp8", "vp9", "av1", "libdav1d", "prores", "ffv1"})
CELLS = (32, 24)
"""Columns and rows of a frame's signature."""
LARGE = (128, 96)
"""The same of what shows the cells of a border."""
ROUNDED = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
"""Without these, colours come out half a code too dark."""
PARTS = 257
"""What the weights of a pattern's frames add up to: 257 times a code of 8 bits is the same one of 16."""

Signatures = NDArray[np.uint8]
"""(frames, rows, columns, 3) uint8: mean RGB codes over each cell of a grid, before rotation."""


class Large(NamedTuple):
    """Some frames of a recording at a size that shows the cells of a border.

    Attributes
    ----------
    grey : (k, rows, columns) uint8
        Luma, before rotation.
    frames : (k,) intp
        Which ones they are, ascending.
    """

    grey: NDArray[np.uint8]
    frames: NDArray[np.intp]


class Share(NamedTuple):
    """A frame that goes into a pattern's mean: when it is shown, in ticks, and its weight out of `PARTS`."""

    tick: int
    weight: int


class Clip:
    """A video, open for reading.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    entry : str
        Its name, for errors.
    memory : int
        Bytes that one frame may take, as it is stored: 16 bits a value.

    Attributes
    ----------
    width, height : int
        Upright: after the container's rotation.

    Raises
    ------
    CaptureError
        If it is no video that can be read, or its frames are too large.
    """

    def __init__(self, file: BinaryIO, entry: str, memory: int) -> None:
        self._entry, self._limit = entry, memory
        try:
            self._container: InputContainer = av.open(
                file, "r", container_options={"format_whitelist": CONTAINERS}, io_open=_refuse
            )
        except (av.FFmpegError, OSError, ValueError) as error:
            raise CaptureError(
                f"{entry} can't be read as a video (MP4, MOV, MKV, WebM or AVI): it is of another kind, cut off or "
                f"damaged ({_said(error)}). Copy it anew from the camera",
                entry=entry,
            ) from error
        try:
            self._stream = self._open()
            self._size = self._stream.codec_context.width, self._stream.codec_context.height
            frames = self._frames()
            first = next(frames, None)
            if first is None:
                raise CaptureError(f"{entry}: no frame of the video can be decoded", entry=entry)
            self._from_start = chain([first], frames)
            self._turn = round(first.rotation / 90) % 4  # quarters, counterclockwise
        except BaseException:
            self._container.close()
            raise
        self.width, self.height = self._size if self._turn % 2 == 0 else self._size[::-1]

    def close(self) -> None:
        """Let go of the decoder; the file stays open."""
        self._container.close()

    @property
    def tick(self) -> float:
        """Seconds of a tick of the container's clock."""
        return float(self._stream.time_base or 1)

    def signatures(self, most: int, every: float = math.inf) -> tuple[Signatures, NDArray[np.int64], Large]:
        """The frames' signatures, and when each is shown, in ticks. Once: it reads the video to its end.

        Parameters
        ----------
        most : int
            Bytes that all of it may take.
        every : float
            Seconds between the frames that are taken large as well: none are if it is infinite.

        Raises
        ------
        CaptureError
            If it takes more, or the frames change their size.
        """
        (columns, rows), (across, down) = (np.minimum(grid, self._size).tolist() for grid in (CELLS, LARGE))
        found, ticks = [], []
        large: dict[int, NDArray[np.uint8]] = {}
        step, due = every / self.tick, -math.inf
        for number, frame in enumerate(self._from_start):
            small = frame.reformat(columns, rows, "rgb24", interpolation=Interpolation.AREA)
            found.append(_pixels(small))
            ticks.append(_tick(frame))
            if step < math.inf and ticks[-1] >= due:
                due = ticks[-1] + step
                large[number] = _pixels(
                    frame.reformat(across, down, "gray", interpolation=Interpolation.AREA)
                )
            if len(found) * found[0].nbytes + len(large) * across * down > most:
                raise CaptureError(
                    f"{self._entry} has more than {len(found)} frames, which is the most that is sorted: cut off "
                    "what was recorded before and after the program",
                    entry=self._entry,
                    limit=len(found),
                )
        grey = np.array(list(large.values()), np.uint8).reshape(-1, down, across)
        return np.stack(found), np.array(ticks, np.int64), Large(grey, np.array(list(large), np.intp))

    def means(self, plan: Sequence[Sequence[Share]]) -> Iterator[NDArray[np.uint16]]:
        """Weighted means of frames.

        Parameters
        ----------
        plan : sequence of sequences of Share
            The frames of each mean, in the order of time; weights add up to `PARTS`.

        Yields
        ------
        (height, width, 3) uint16
            Means of the 8-bit codes, times 257: exact.

        Raises
        ------
        CaptureError
            If a frame can't be found again.
        """
        try:
            self._container.seek(plan[0][0].tick, stream=self._stream, backward=True)
            frames = self._frames()
        except av.FFmpegError:  # there is no index, or it is damaged
            frames = self._from_start
        frame = next(frames, None)
        for shares in plan:
            mean = np.zeros((self._size[1], self._size[0], 3), np.uint16)
            for tick, weight in shares:
                while frame is not None and _tick(frame) < tick:
                    frame = next(frames, None)
                if frame is None or frame.pts != tick:
                    raise CaptureError(
                        f"{self._entry}: a frame at {tick * self.tick:.3f} s can't be decoded again: the video is "
                        "damaged there. Copy it anew from the camera",
                        entry=self._entry,
                    )
                mean += _pixels(frame.reformat(format="rgb24", interpolation=ROUNDED)) * np.uint16(weight)
            yield np.ascontiguousarray(np.rot90(mean, self._turn))

    def _open(self) -> VideoStream:
        if not self._container.streams.video:
            raise CaptureError(f"{self._entry} has no video in it", entry=self._entry)
        stream = self._container.streams.video[0]
        codec: Any = stream.codec_context
        if codec is None or codec.name not in CODECS:
            name = "an unknown codec" if codec is None else codec.name
            raise CaptureError(
                f"{self._entry} is coded by {name}: H.264, HEVC and MJPEG are read, and {', '.join(sorted(CODECS))}",
                entry=self._entry,
            )
        self._see_that_it_fits(codec.width, codec.height)
        # What the container says may not be what the stream says: a decoder makes room for no more than this.
        # Damage is to be an error, not a guess at what was there.
        codec.options = {"max_pixels": str(max(self._limit // 6, 1)), "err_detect": "explode"}
        codec.thread_count, codec.thread_type = 2, "AUTO"
        return stream

    def _frames(self) -> Iterator[VideoFrame]:
        """The frames in the order of time, from where the container stands.

        Packets that can't be decoded are passed over, and what can't be read any more ends the video: what is lost
        shows in the patterns.
        """
        last: int | None = None
        for frame in self._decoded():
            if frame.pts is None:
                raise CaptureError(
                    f"{self._entry}: its frames have no timestamps; put it into an MP4 that has them",
                    entry=self._entry,
                )
            if (frame.width, frame.height) != self._size:
                raise CaptureError(
                    f"{self._entry} has a frame of {frame.width} x {frame.height} pixels where it says "
                    f"{self._size[0]} x {self._size[1]}: record it in one go, and copy it anew from the camera",
                    entry=self._entry,
                )
            if last is None or frame.pts > last:
                last = frame.pts
                yield frame

    def _decoded(self) -> Iterator[VideoFrame]:
        packets, whole = self._container.demux(self._stream), True
        while True:
            try:
                packet = next(packets)
            except (StopIteration, av.FFmpegError, OSError):
                return
            try:
                frames = self._stream.decode(packet)
            except av.FFmpegError:
                whole = False
                continue
            for frame in frames:
                # What was lost goes on from frame to frame until one is coded by itself.
                whole = not frame.is_corrupt and (whole or frame.key_frame)
                if whole:
                    yield frame

    def _see_that_it_fits(self, width: int, height: int) -> None:
        if 6 * width * height > self._limit:
            raise CaptureError(
                f"{self._entry} has frames of {width} x {height} pixels, which take more than the {self._limit} bytes "
                "allowed for one: record or scale it smaller",
                entry=self._entry,
                limit=self._limit,
            )


def opened(file: BinaryIO, entry: str, memory: int) -> "closing[Clip]":
    """A `Clip` for a with block."""
    return closing(Clip(file, entry, memory))


def _tick(frame: VideoFrame) -> int:
    assert frame.pts is not None  # `_frames` gives no other
    return frame.pts


def _pixels(frame: VideoFrame) -> NDArray[np.uint8]:
    pixels: NDArray[np.uint8] = np.asarray(frame.to_ndarray(), np.uint8)
    return pixels


def _refuse(url: str, *_: object) -> BinaryIO:
    raise OSError(f"{url} is not in the video")


def _said(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
