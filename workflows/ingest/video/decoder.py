"""A video in a bundle: opened as hostile, looked over frame by frame, and averaged."""

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from fractions import Fraction
from itertools import chain
from typing import Any, BinaryIO, NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Interpolation
from av.video.stream import VideoStream
from numpy.typing import NDArray

from storage.errors import CaptureError
from workflows.untrusted.decoder_guard import Guard

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
"""What is probed for. Others, playlists among them, name files and hosts of their own."""
CODECS = frozenset({"h264", "hevc", "mjpeg", "mpeg4", "vp8", "vp9", "av1", "libdav1d", "prores", "ffv1"})
CELLS = (32, 24)
"""Columns and rows of a frame's signature."""
LARGE = (128, 96)
"""The same of what shows the cells of a border."""
PLANAR = {
    "gray": "gray16le",
    **{
        name: f"yuv{kind}p16le"
        for kind in (420, 422, 444)
        for name in (f"yuv{kind}p", f"yuvj{kind}p", *(f"yuv{kind}p{bits}le" for bits in (10, 12, 16)))
    },
}
"""Formats of frames that are averaged as they are, and the same with 16 bits a value."""
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
    lost : list of int
        When frames that could not be decoded were to be shown, in ticks, as far as the video was read.

    Raises
    ------
    CaptureError
        If it is no video that can be read, or its frames are too large.
    """

    def __init__(self, file: BinaryIO, entry: str, memory: int) -> None:
        self._entry, self._limit = entry, memory
        self._guard = Guard(entry, memory)
        self.lost: list[int] = []
        try:
            with self._guard.on():
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
                # FFmpeg leaves out an index that it has no memory for, and says nothing.
                raise CaptureError(
                    f"{entry}: no frame of the video can be decoded: it is damaged, or has an index that takes too "
                    "much memory. Copy it anew from the camera",
                    entry=entry,
                )
            self._from_start = chain([first], frames)
            self._turn = round(first.rotation / 90) % 4  # quarters, counterclockwise
        except BaseException:
            self._container.close()
            raise
        self.width, self.height = self._size if self._turn % 2 == 0 else self._size[::-1]

    def close(self) -> None:
        """Let go of the decoder; the file stays open."""
        # Which holds this clip, and so would hold the decoder's threads and frames until cycles are collected.
        self._from_start = chain()
        self._container.close()

    @property
    def tick(self) -> float:
        """Seconds of a tick of the container's clock."""
        return float(self.time_base)

    @property
    def time_base(self) -> Fraction:
        """The same, exactly."""
        return self._stream.time_base or Fraction(1)

    @property
    def announced(self) -> float:
        """Seconds that it lasts by what the container says; 0 if it does not say."""
        if self._stream.duration is not None:
            return float(self._stream.duration * self.time_base)
        return (self._container.duration or 0) / av.time_base

    def ticks(self, most: int) -> tuple[NDArray[np.int64], int]:
        """When each frame is shown, and for how long the last one is, in ticks. Once: it reads the video to its end.

        Raises
        ------
        CaptureError
            If there are more than ``most``.
        """
        found, last = [], 0
        for frame in self._from_start:
            found.append(_tick(frame))
            last = int(frame.duration or 0)
            if len(found) > most:
                raise CaptureError(
                    f"{self._entry} has more than {most} frames: cut it into several",
                    entry=self._entry,
                    limit=most,
                )
        return np.array(found, np.int64), last or (found[-1] - found[-2] if len(found) > 1 else 1)

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
        """Weighted means of frames, in the colour system of the video, brought to RGB.

        Parameters
        ----------
        plan : sequence of sequences of Share
            The frames of each mean, in the order of time; weights add up to `PARTS`.

        Yields
        ------
        (height, width, 3) uint16
            65535 for a code of 255.

        Raises
        ------
        CaptureError
            If a frame can't be found again.
        """
        try:
            with self._guard.on():
                self._container.seek(plan[0][0].tick, stream=self._stream, backward=True)
            frames = self._frames()
        except av.FFmpegError:  # there is no index, or it is damaged
            frames = self._from_start
        frame = next(frames, None)
        for shares in plan:
            sums: list[NDArray[Any]] = []
            for tick, weight in shares:
                while frame is not None and _tick(frame) < tick:
                    frame = next(frames, None)
                if frame is None or frame.pts != tick:
                    raise CaptureError(
                        f"{self._entry}: a frame at {tick * self.tick:.3f} s can't be decoded again: the video is "
                        "damaged there. Copy it anew from the camera",
                        entry=self._entry,
                    )
                seen = frame if frame.format.name in PLANAR else frame.reformat(format="yuv444p16le")
                planes = _planes(seen)
                if not sums:
                    # what the weights add up to times a code of 8 bits just fits
                    kind = np.uint16 if planes[0].dtype == np.uint8 else np.uint32
                    sums = [np.zeros(plane.shape, kind) for plane in planes]
                for total, plane in zip(sums, planes, strict=True):
                    total += np.multiply(plane, weight, dtype=total.dtype)
            yield np.ascontiguousarray(np.rot90(_to_rgb(sums, seen), self._turn))

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
            with self._guard.on():
                try:
                    packet = next(packets)
                except MemoryError:
                    raise
                except (StopIteration, av.FFmpegError, OSError):
                    return
                try:
                    frames = self._stream.decode(packet)
                except MemoryError:
                    raise
                except av.FFmpegError:
                    whole = False
                    if packet.pts is not None:
                        self.lost.append(packet.pts)
                    continue
            for frame in frames:
                # What was lost goes on from frame to frame until one is coded by itself.
                whole = not frame.is_corrupt and (whole or frame.key_frame)
                if whole:
                    yield frame
                elif frame.pts is not None:
                    self.lost.append(frame.pts)

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


def _planes(frame: VideoFrame) -> list[NDArray[Any]]:
    """The planes of a frame of one of `PLANAR`, each (rows, columns)."""
    kind: np.dtype[Any] = np.dtype("u1" if frame.format.components[0].bits == 8 else "<u2")
    return [
        np.frombuffer(memoryview(plane), kind).reshape(plane.height, plane.line_size // kind.itemsize)[
            :, : plane.width
        ]
        for plane in frame.planes
    ]


def _to_rgb(sums: Sequence[NDArray[Any]], like: VideoFrame) -> NDArray[np.uint16]:
    """(height, width, 3) RGB of a mean: of its planes times `PARTS`, in the colour system of a frame.

    Notes
    -----
    Limited codes (ITU-R BT.709, sect. 6.10: black 16, white 235, colours 112 about 128) are stretched to full ones
    here: swscale takes the white of 16 bits for a little less than white, so that it would never be clipped.
    """
    name, bits = like.format.name, like.format.components[0].bits
    full = like.color_range == ColorRange.JPEG or name.startswith(("gray", "yuvj"))
    step = 2.0 ** (bits - 8)
    mean = VideoFrame(like.width, like.height, PLANAR[name])
    mean.colorspace, mean.color_range = like.colorspace, ColorRange.JPEG
    for at, (total, plane) in enumerate(zip(sums, mean.planes, strict=True)):
        # the code that becomes zero, or grey; how many there are from black to white; what the first becomes
        zero, span, level = (128 * step, 224 * step, 32768) if at else (16 * step, 219 * step, 0)
        if full:
            zero, span = (128 * step if at else 0, 2.0**bits - 1)
        scaled = (total / np.float32(PARTS) - np.float32(zero)) * np.float32(65535 / span) + np.float32(level)
        rows = np.zeros((plane.height, plane.line_size // 2), "<u2")
        rows[:, : plane.width] = np.rint(np.clip(scaled, 0, 65535))
        plane.update(rows.tobytes())
    rgb = mean.reformat(format="rgb48le", interpolation=ROUNDED)
    return np.asarray(rgb.to_ndarray(), np.uint16)


def _refuse(url: str, *_: object) -> BinaryIO:
    raise OSError(f"{url} is not in the video")


def _said(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
