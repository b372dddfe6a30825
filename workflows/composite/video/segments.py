"""Segments of a video: each encoded by itself, in any order, and joined without encoding them again.

Every segment begins with a frame that is coded by itself, and none has frames that are coded out of their order, so
that one follows another whatever is in them, and a frame is a packet: the times are given to packets when they are
joined.
"""

import io
from collections.abc import Iterable
from fractions import Fraction
from itertools import pairwise
from typing import BinaryIO, Literal

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from numpy.typing import NDArray

from storage.errors import Corrupt
from workflows.ingest.video.frame_means import ACCURATE

TRANSFERS = {"srgb": ColorTrc.BT709, "linear": ColorTrc.LINEAR}
"""What a video says of its tone curve. Pictures made for screens go by sRGB, and videos of them say BT.709."""
CODER = {"crf": "16", "preset": "veryfast", "bf": "0", "mbtree": "0"}
"""With its macroblock tree (mbtree) x264 was seen to give other bytes for the same frames."""
SAMPLE = 36
"""Bytes of an MP4's tables for a frame, at most: its size, its time, its key and a chunk of its own."""
TABLES = 1 << 14
"""Bytes of those tables besides."""


def encode(
    pictures: Iterable[NDArray[np.uint8]], rate: int, most: int, transfer: Literal["srgb", "linear"]
) -> bytes:
    """Encode pictures as a segment: H.264, 4:2:0, limited range, BT.709.

    Parameters
    ----------
    pictures : iterable of (height, width, 3) uint8
        All of one size. An odd height or width becomes even, as 4:2:0 wants it: the last row or column is repeated.
    rate : int
        Pictures a second, about: levels of H.264 go by it. The same in all segments of a video.
    most : int
        Pictures that a segment has at most. The same in all segments of a video.
    transfer : str
        How they are encoded.

    Returns
    -------
    bytes
        An MP4; the same for the same pictures.
    """
    target = io.BytesIO()
    with av.open(target, "w", format="mp4", options={"fflags": "+bitexact"}) as video:
        stream = video.add_stream("libx264", rate=rate, options=CODER)
        codec = stream.codec_context
        codec.thread_count, codec.gop_size = 1, most  # bytes would differ by the number of threads
        codec.color_range, codec.colorspace = ColorRange.MPEG, Colorspace.ITU709
        codec.color_primaries, codec.color_trc = ColorPrimaries.BT709, TRANSFERS[transfer]
        stream.pix_fmt = "yuv420p"
        for number, picture in enumerate(pictures):
            height, width, _ = picture.shape
            even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if not number:
                stream.height, stream.width, _ = even.shape
            frame = VideoFrame.from_ndarray(even, "rgb24").reformat(
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                src_color_range=ColorRange.JPEG,
                dst_color_range=ColorRange.MPEG,
                interpolation=ACCURATE,
            )
            frame.pts, frame.time_base = number, Fraction(1, rate)
            video.mux(stream.encode(frame))
        video.mux(stream.encode(None))
    return target.getvalue()


def join(
    segments: Iterable[bytes], ticks: NDArray[np.int64], last: int, tick: Fraction, target: BinaryIO
) -> None:
    """Join segments into an MP4 that can be played while it is loaded.

    Parameters
    ----------
    segments : iterable of bytes
        What `encode` gave, in order.
    ticks : (frames,) int64
        When each frame is shown, ascending: the video begins with the first.
    last : int
        For how many ticks the last one is.
    tick : Fraction
        Seconds of a tick.
    target : BinaryIO
        To write to, seekable.

    Raises
    ------
    Corrupt
        If the segments are not those of one video of so many frames.
    """
    # The tables go before the frames, where room for them is kept: they are written when the frames are known.
    options = {"fflags": "+bitexact", "moov_size": str(TABLES + SAMPLE * len(ticks))}
    ends = np.append(ticks, ticks[-1] + last)
    times = pairwise((ends - ticks[0]).tolist())
    with av.open(target, "w", format="mp4", options=options) as video:
        stream = None
        header = b""
        for data in segments:
            with av.open(io.BytesIO(data), "r", format="mp4") as segment:
                found = segment.streams.video[0]
                if stream is None:
                    stream = video.add_stream_from_template(found)
                    stream.time_base = tick
                    header = found.codec_context.extradata or b""
                elif found.codec_context.extradata != header:
                    raise Corrupt("the segments of the video do not fit together; composite the clip again")
                for packet in segment.demux(found):
                    if not packet.size:  # the end
                        continue
                    start, end = next(times, (None, 0))
                    if start is None:
                        raise Corrupt("the segments of the video have too many frames; composite it again")
                    packet.stream, packet.time_base = stream, tick
                    packet.pts = packet.dts = start
                    packet.duration = end - start
                    video.mux(packet)
    if next(times, None) is not None:
        raise Corrupt("the segments of the video have too few frames; composite the clip again")
