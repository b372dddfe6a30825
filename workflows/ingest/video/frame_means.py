"""Weighted means of a video's frames: one RGB image of 16 bits for each pattern."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from av.video.format import VideoFormat
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from numba import njit
from numpy.typing import NDArray

from storage.errors import CaptureError
from workflows.images.hdr import is_hdr, to_srgb
from workflows.ingest.video.clip import UNSTATED, Clip, tick_of

PLANAR = {
    "gray": "gray16le",
    **{
        name: f"yuv{kind}p16le"
        for kind in (420, 422, 444)
        for name in (f"yuv{kind}p", f"yuvj{kind}p", *(f"yuv{kind}p{bits}le" for bits in (10, 12, 16)))
    },
}
"""Pixel formats whose planes are averaged as they are, and the same formats with 16 bits a value."""
ACCURATE = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
"""Without these flags, swscale makes colours half a code too dark."""
SD_ROWS = 576
"""Pictures with more rows are by BT.709 if nothing else is stated, others by BT.601, as in players."""
TOTAL_WEIGHT = 257
"""The sum of the weights of a pattern's frames: 257 times a code of 8 bits is the same code in 16 bits."""


class Share(NamedTuple):
    """A frame that goes into a pattern's mean: its time in ticks, and its weight out of `TOTAL_WEIGHT`."""

    tick: int
    weight: int


class Look(NamedTuple):
    """How the planes of a frame become RGB.

    Attributes
    ----------
    format : str
        A key of `PLANAR`.
    width, height : int
        Before rotation.
    matrix, range, transfer, primaries : int
        The colour system (ITU-T H.273, tables 2 to 4) and the range, as FFmpeg numbers them.
    interlaced : bool
        Whether every second row is of another time, and has colours of its own.
    quarter_turns : int
        Counterclockwise, to an upright picture.
    """

    format: str
    width: int
    height: int
    matrix: int
    range: int
    transfer: int
    primaries: int
    interlaced: bool
    quarter_turns: int


class FrameSum(NamedTuple):
    """A weighted sum of frames: each of their planes, (rows, columns) uint16 or uint32, and what they stand for."""

    planes: list[NDArray[Any]]
    look: Look


def mean_frames(
    clip: Clip, plan: Sequence[Sequence[Share]], full: float = 1.0
) -> Iterator[NDArray[np.uint16]]:
    """Weighted means of frames, averaged in the colour system of the video and then converted to RGB, from HDR to sRGB.

    Parameters
    ----------
    clip : Clip
    plan : sequence of sequences of Share
        The frames of each mean, in the order of time; weights add up to `TOTAL_WEIGHT`.
    full : float
        The light of HDR that becomes full scale, see `workflows.images.hdr.to_srgb`.

    Yields
    ------
    (height, width, 3) uint16
        Upright; 65535 for a code of 255.

    Raises
    ------
    CaptureError
        If a frame can't be decoded again.
    """
    frames = clip.frames_from(plan[0][0].tick)
    frame = next(frames, None)

    def weighted(shares: Sequence[Share]) -> Iterator[tuple[VideoFrame, int]]:
        nonlocal frame
        for tick, weight in shares:
            while frame is not None and tick_of(frame) < tick:
                frame = next(frames, None)
            if frame is None or frame.pts != tick:
                raise CaptureError(
                    f"{clip.entry}: a frame at {tick * clip.tick:.3f} s can't be decoded again: the video is "
                    "damaged there. Copy it again from the camera",
                    entry=clip.entry,
                )
            yield frame, weight

    for shares in plan:
        yield mean_of(add_up(weighted(shares), clip.quarter_turns), full)


def add_up(frames: Iterable[tuple[VideoFrame, int]], quarter_turns: int) -> FrameSum:
    """The sum of frames of one clip, with weights that add up to `TOTAL_WEIGHT`."""
    sums: list[NDArray[Any]] = []
    for frame, weight in frames:
        seen = _planar(frame)
        planes = _planes(seen)
        if not sums:
            # TOTAL_WEIGHT times a code of 8 bits just fits into 16.
            kind = np.uint16 if planes[0].dtype == np.uint8 else np.uint32
            sums = [np.zeros(plane.shape, kind) for plane in planes]
        for total, plane in zip(sums, planes, strict=True):
            _add(total, np.ascontiguousarray(plane), weight)
    look = Look(
        seen.format.name,
        seen.width,
        seen.height,
        int(seen.colorspace),
        int(seen.color_range),
        int(seen.color_trc),
        int(seen.color_primaries),
        bool(seen.interlaced_frame),
        quarter_turns,
    )
    return FrameSum(sums, look)


@njit(
    ["void(uint16[:, ::1], uint8[:, ::1], uint16)", "void(uint32[:, ::1], uint16[:, ::1], uint32)"],
    nogil=True,
    cache=True,
)
def _add(total: NDArray[Any], plane: NDArray[Any], weight: int) -> None:
    """Add a plane times its weight: in one go, while numpy writes the product to memory and reads it again."""
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            total[y, x] += plane[y, x] * weight


def mean_of(total: FrameSum, full: float) -> NDArray[np.uint16]:
    """The mean of frames as `mean_frames` yields it, of their sum."""
    look = total.look
    rgb = _to_rgb(total)
    if is_hdr(look.transfer):
        rgb = to_srgb(rgb, look.transfer, look.primaries, full)
    return np.ascontiguousarray(np.rot90(rgb, look.quarter_turns))


def shares_of(ticks: NDArray[np.int64], weights: NDArray[np.float64]) -> list[Share]:
    """Weights as integers that add up to `TOTAL_WEIGHT`, by the largest remainder method."""
    exact = TOTAL_WEIGHT * weights / weights.sum()
    parts = np.floor(exact).astype(int)
    parts[np.argsort(parts - exact, kind="stable")[: TOTAL_WEIGHT - parts.sum()]] += 1
    return [Share(int(tick), int(part)) for tick, part in zip(ticks, parts, strict=True) if part]


def _planar(frame: VideoFrame) -> VideoFrame:
    """A frame in a `PLANAR` format, and in a colour system that is stated if it is not the usual one of its size."""
    if frame.format.name not in PLANAR:
        return frame.reformat(format="yuv444p16le")
    if frame.colorspace == UNSTATED and frame.height > SD_ROWS:
        frame.colorspace = Colorspace.ITU709
    return frame


def _planes(frame: VideoFrame) -> list[NDArray[Any]]:
    """The planes of a frame in a `PLANAR` format, each (rows, columns)."""
    kind: np.dtype[Any] = np.dtype("u1" if frame.format.components[0].bits == 8 else "<u2")
    return [_values(plane, kind) for plane in frame.planes]


def _values(plane: VideoPlane, kind: np.dtype[Any]) -> NDArray[Any]:
    """The values of a plane, (rows, columns), in its own memory."""
    rows = np.frombuffer(memoryview(plane), kind).reshape(plane.height, plane.line_size // kind.itemsize)
    return rows[:, : plane.width]


def _to_rgb(total: FrameSum) -> NDArray[np.uint16]:
    """(height, width, 3) RGB of a sum of frames, before rotation.

    Notes
    -----
    Limited range (ITU-R BT.709, sect. 6.10: black 16, white 235, colours 112 about 128) is stretched to full range
    here: swscale takes the white of 16 bits for a little less than white, so that it would never be clipped.
    """
    look = total.look
    bits = VideoFormat(look.format).components[0].bits
    full = look.range == ColorRange.JPEG or look.format.startswith(("gray", "yuvj"))
    step = 2.0 ** (bits - 8)
    planes = []
    for at, plane in enumerate(total.planes):
        # The code of black, or of grey in a colour plane; the codes from black to white; the result for `zero`.
        zero, span, level = (128 * step, 224 * step, 32768) if at else (16 * step, 219 * step, 0)
        if full:
            zero, span = (128 * step if at else 0, 2.0**bits - 1)
        scale = 65535 / span
        scaled = np.multiply(plane, np.float32(scale / TOTAL_WEIGHT), dtype=np.float32)
        scaled += np.float32(level - zero * scale)
        # In place: new memory costs as much as the sums.
        planes.append(np.rint(np.clip(scaled, 0, 65535, out=scaled), out=scaled).astype("<u2"))
    if not look.interlaced or look.height % 4:
        return _convert(planes, look)
    # Each field has the colours of its own rows.
    rgb = np.empty((look.height, look.width, 3), np.uint16)
    for field in (0, 1):
        rgb[field::2] = _convert([plane[field::2] for plane in planes], look)
    return rgb


def _convert(planes: Sequence[NDArray[np.uint16]], look: Look) -> NDArray[np.uint16]:
    """(height, width, 3) RGB of planes of 16 bits and full range, of as many rows as the first has."""
    mean = VideoFrame(look.width, len(planes[0]), PLANAR[look.format])
    mean.colorspace, mean.color_range = look.matrix, ColorRange.JPEG
    for pixels, plane in zip(planes, mean.planes, strict=True):
        _values(plane, np.dtype("<u2"))[:] = pixels
    rgb = mean.reformat(format="rgb48le", interpolation=ACCURATE)
    return np.asarray(rgb.to_ndarray(), np.uint16)
