"""An untrusted video: opened with bounds on its format and the size of its frames, and decoded in the order of time.

What decoding takes is bounded by the process that does it, see `workflows.untrusted.decoder`.
"""

from collections.abc import Iterator
from contextlib import closing
from fractions import Fraction
from itertools import chain
from typing import Any, BinaryIO

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from storage.errors import CaptureError
from workflows.images.heif import is_heif
from workflows.untrusted.decoder_process import say_alive

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"
"""Formats that FFmpeg may probe for. Others, such as playlists, name further files and hosts to open."""
CODECS = frozenset(
    {"h264", "hevc", "mjpeg", "mpeg2video", "mpeg4", "vp8", "vp9", "av1", "libdav1d", "prores", "ffv1"}
)
BACK = (0, 2, 10, 60)
"""Seconds before a time at which reading begins to find it. A transport stream has no index, and is entered anywhere:
nothing can be decoded up to the next key frame."""
_HEAD = 12  # bytes that tell HEIC
UNSTATED = 2
"""A transfer, primaries or a colour system that is not stated (ITU-T H.273, tables 2 to 4)."""


class Clip:
    """A video, open for reading.

    Parameters
    ----------
    file : BinaryIO
        Seekable.
    entry : str
        Its name, for errors.
    memory : int
        Bytes that one frame may take, at 16 bits a value.
    threads : int
        Threads that decode; each holds a frame.

    Attributes
    ----------
    width, height : int
        Upright, that is after the rotation that the container asks for.
    size : (int, int)
        Width and height as stored, before rotation.
    quarter_turns : int
        Counterclockwise quarter turns from a stored frame to an upright one.
    transfer : int
        Transfer characteristics of the first frame (ITU-T H.273, table 3).
    lost : list of int
        Times, in ticks, of the frames that could not be decoded, as far as the video has been read.
    interlaced : bool
        Whether any frame holds two pictures of different times, in alternate rows, as far as the video has been read.

    Raises
    ------
    CaptureError
        If it cannot be read as a video, or its frames are too large.
    """

    def __init__(self, file: BinaryIO, entry: str, memory: int, threads: int = 2) -> None:
        self.entry, self._limit, self._threads = entry, memory, threads
        self.lost: list[int] = []
        self.interlaced = False
        head = file.read(_HEAD)
        file.seek(0)
        if is_heif(head):  # FFmpeg reads a tile of the picture as a film of one frame
            raise CaptureError(
                f"{entry} is a picture in HEIC, not a film: give it as a frame, or film the patterns",
                entry=entry,
            )
        try:
            self._container: InputContainer = av.open(
                file, "r", container_options={"format_whitelist": CONTAINERS}, io_open=_refuse
            )
        except (av.FFmpegError, OSError, ValueError) as error:
            raise CaptureError(
                f"{entry} can't be read as a video (MP4, MOV, MTS, MKV, WebM or AVI): it is of another kind, cut off "
                "or damaged, or has an index that takes too much memory. Copy it again from the camera, or export it "
                "as MP4",
                entry=entry,
            ) from error
        try:
            self._stream = self._open()
            self._stated = _colours(self._stream.codec_context)
            self.size = self._stream.codec_context.width, self._stream.codec_context.height
            frames = self._frames()
            first = next(frames, None)
            if first is None:
                # FFmpeg silently leaves out an index that it has no memory for.
                raise CaptureError(
                    f"{entry}: no frame of the video can be decoded: it is cut off or damaged, or has an index that "
                    "takes too much memory. Copy it again from the camera",
                    entry=entry,
                )
            self._from_start = chain([first], frames)
            self._first, self.transfer = tick_of(first), int(first.color_trc)
            self.quarter_turns = round(first.rotation / 90) % 4
        except BaseException:
            self._container.close()
            raise
        self.width, self.height = self.size if self.quarter_turns % 2 == 0 else self.size[::-1]

    def close(self) -> None:
        """Close the decoder; the file stays open."""
        # The iterator refers to this clip: the decoder's threads and frames would stay until garbage is collected.
        self._from_start = chain()
        self._container.close()

    @property
    def tick(self) -> float:
        """Length of a tick, the unit of the container's timestamps, in seconds."""
        return float(self.time_base)

    @property
    def time_base(self) -> Fraction:
        """Length of a tick in seconds, exactly."""
        return self._stream.time_base or Fraction(1)

    @property
    def stated_duration(self) -> float:
        """Duration in seconds that the container states; 0 if it states none."""
        if self._stream.duration is not None:
            return float(self._stream.duration * self.time_base)
        return (self._container.duration or 0) / av.time_base

    def frames(self) -> Iterator[VideoFrame]:
        """All frames in the order of time. They can be read only once."""
        return self._from_start

    def frames_from(self, tick: int) -> Iterator[VideoFrame]:
        """Frames in the order of time that begin at ``tick`` or before it."""
        for back in BACK:
            if not self._seek(tick, back):  # there is no index, or it is damaged
                break
            frames = self._frames(entered=True)
            first = next(frames, None)
            if first is not None and tick_of(first) <= tick:
                return chain([first], frames)
        return self._frames() if self._seek(self._first, BACK[-1]) else self._from_start

    def ticks(self, max_frames: int) -> tuple[NDArray[np.int64], int]:
        """When each frame is shown, and for how long the last one is, in ticks. This reads all `frames`.

        Raises
        ------
        CaptureError
            If there are more than ``max_frames``.
        """
        found, last = [], 0
        for frame in self.frames():
            found.append(tick_of(frame))
            last = int(frame.duration or 0)
            if len(found) > max_frames:
                raise CaptureError(
                    f"{self.entry} has more than {max_frames} frames: cut it into several",
                    entry=self.entry,
                    limit=max_frames,
                )
        return np.array(found, np.int64), last or (found[-1] - found[-2] if len(found) > 1 else 1)

    def _open(self) -> VideoStream:
        stream = self._container.streams.best("video")  # the others are covers and previews
        if not isinstance(stream, VideoStream):
            raise CaptureError(f"{self.entry} has no video in it", entry=self.entry)
        codec: Any = stream.codec_context
        if codec is None or codec.name not in CODECS:
            name = "an unknown codec" if codec is None else codec.name
            raise CaptureError(
                f"{self.entry} is coded by {name}: export it as H.264, HEVC or MJPEG ({', '.join(sorted(CODECS))} are "
                "read)",
                entry=self.entry,
            )
        self._check_size(codec.width, codec.height)
        # The stream may state another size than the container: the decoder allocates no more than max_pixels.
        # With "explode", damage is an error rather than a guess at what was there.
        codec.options = {"max_pixels": str(max(self._limit // 6, 1)), "err_detect": "explode"}
        codec.thread_count, codec.thread_type = self._threads, "AUTO"
        return stream

    def _seek(self, tick: int, back: int) -> bool:
        """Move to a key frame some seconds before ``tick``, as well as the container can; whether it could at all."""
        try:
            self._container.seek(tick - round(back / self.tick), stream=self._stream, backward=True)
        except av.FFmpegError:
            return False
        return True

    def _frames(self, entered: bool = False) -> Iterator[VideoFrame]:
        """The frames in the order of time, from the container's present position.

        If the video is ``entered`` somewhere, they begin with a key frame: others may be made of frames before it.

        Packets that can't be decoded are skipped, and a read error ends the video: patterns that lose frames by it are
        reported later.
        """
        last: int | None = None
        for frame in self._decoded(entered):
            if frame.pts is None:
                raise CaptureError(
                    f"{self.entry}: its frames have no timestamps; put it into an MP4 that has them",
                    entry=self.entry,
                )
            if (frame.width, frame.height) != self.size:
                raise CaptureError(
                    f"{self.entry} has a frame of {frame.width} x {frame.height} pixels where it says "
                    f"{self.size[0]} x {self.size[1]}: record it in one go, and copy it again from the camera",
                    entry=self.entry,
                )
            if last is None or frame.pts > last:
                last = frame.pts
                yield frame

    def _decoded(self, entered: bool) -> Iterator[VideoFrame]:
        """The frames that were decoded without error; the times of the others are added to `lost`."""
        packets, intact = self._container.demux(self._stream), not entered
        while True:
            say_alive()
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
            except (av.FFmpegError, ValueError):  # ValueError: the codec changes to an unknown one
                intact = False
                if packet.pts is not None:
                    self.lost.append(packet.pts)
                continue
            for frame in frames:
                # Damage spreads from frame to frame until a key frame.
                intact = not frame.is_corrupt and (intact or frame.key_frame)
                if intact:
                    self.interlaced |= bool(frame.interlaced_frame)
                    self._colour(frame)
                    yield frame
                elif frame.pts is not None:
                    self.lost.append(frame.pts)

    def _colour(self, frame: VideoFrame) -> None:
        """Give a frame without colours of its own those that the container states: of HEVC, FFmpeg forgets them."""
        if {*_colours(frame)[:3]} == {UNSTATED}:
            frame.color_trc, frame.color_primaries, frame.colorspace, frame.color_range = self._stated

    def _check_size(self, width: int, height: int) -> None:
        if 6 * width * height > self._limit:
            raise CaptureError(
                f"{self.entry} has frames of {width} x {height} pixels, which take more than the {self._limit} bytes "
                "allowed for one: record or scale it smaller",
                entry=self.entry,
                limit=self._limit,
            )


def open_clip(file: BinaryIO, entry: str, memory: int, threads: int = 2) -> "closing[Clip]":
    """Open a `Clip` in a with statement."""
    return closing(Clip(file, entry, memory, threads))


def tick_of(frame: VideoFrame) -> int:
    """When a frame of a `Clip` is shown, in ticks."""
    assert frame.pts is not None  # Clip yields no other
    return frame.pts


def _colours(of: Any) -> tuple[int, int, int, int]:
    """The transfer, the primaries, the colour system and the range of a frame, or of a codec."""
    return of.color_trc, of.color_primaries, of.colorspace, of.color_range


def _refuse(url: str, *_: object) -> BinaryIO:
    raise OSError(f"{url} is not in the video")
