"""A camera that films a monitor without being synchronised with it, and the truth about its frames."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from tests.parts.captures import zip_bytes
from workflows.images.tone_curves import from_light, to_light
from workflows.programs.program import Program
from workflows.simulation.scene import Scene

Floats = NDArray[np.float32]
TICK = 90_000
CODECS = {
    "libx264": {"crf": "16", "preset": "veryfast"},
    "libx265": {"crf": "16", "preset": "ultrafast", "x265-params": "log-level=none"},
    "mjpeg": {"qmin": "2", "qmax": "3"},
}


@dataclass(frozen=True)
class Camera:
    """How a program is shown and filmed: times in seconds; ``exposure`` in frames, ``readout`` of all rows."""

    fps: float = 30
    hold: float = 0.3
    jitter: float = 0.1
    lead: float = 0.71
    tail: float = 0.64
    exposure: float = 0.5
    readout: float = 0.02
    uneven: float = 0.0
    idle: float = 0.35
    codec: str = "libx264"
    container: str = "mp4"
    seed: int = 0
    hand: tuple[float, float] = (0, 0)
    cut: tuple[float, float] = (0, 0)
    options: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Film:
    """A video, and what its frames show.

    Attributes
    ----------
    data : bytes
    starts : (n + 1,) float64
        When each pattern began, and the last one ended, as the video's times.
    shown : dict of int to (n + 2,) float64
        Of each frame, by its time in units of 1 / `TICK`: the share of its light that comes from each pattern, and from
        before and after the program.
    light : list of (height, width, 3) float32
        Of each pattern.
    """

    data: bytes
    starts: NDArray[np.float64]
    shown: dict[int, NDArray[np.float64]]
    light: list[Floats]


def lights(scene: Scene, program: Program) -> list[Floats]:
    """The light of each pattern at the camera."""
    return [scene.truth(to_light(picture, "linear")) for picture in program.pictures(0, program.count)]


def film(light: Sequence[Floats], camera: Camera) -> Film:
    """Film patterns one after another."""
    random = np.random.Generator(np.random.PCG64(camera.seed))
    n, (height, width, _) = len(light), light[0].shape
    holds = camera.hold * (1 + camera.jitter * np.clip(random.standard_normal(n), -2, 2))
    starts = camera.lead + np.concatenate([[0], np.cumsum(holds)])
    times = np.arange(0, starts[-1] + camera.tail, 1 / camera.fps)
    times = times + camera.uneven / camera.fps * random.uniform(-0.5, 0.5, len(times))
    times = times[(times < camera.cut[0]) | (times >= camera.cut[1])]
    idle = camera.idle * np.max(light, axis=0)
    pictures = np.stack([*light, idle])
    edges = np.concatenate([[-np.inf], starts, [np.inf]])
    target, shown = io.BytesIO(), {}
    with av.open(target, "w", format=camera.container) as box:
        stream = box.add_stream(camera.codec, rate=Fraction(camera.fps).limit_denominator(1000))
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuvj420p" if camera.codec == "mjpeg" else "yuv420p"
        stream.options = CODECS[camera.codec] | camera.options
        base = Fraction(1, TICK) if camera.container != "avi" else Fraction(1 / Fraction(camera.fps))
        stream.codec_context.time_base = base
        for number, time in enumerate(times):
            begin = time + camera.readout * np.arange(height) / height
            end = begin + camera.exposure / camera.fps
            share = np.diff(np.clip(edges, begin[:, None], end[:, None]), axis=1)
            share = np.concatenate([share[:, 1:-1], share[:, :1] + share[:, -1:]], axis=1)
            share /= share.sum(axis=1, keepdims=True)
            picture = np.zeros_like(idle)
            for k in np.flatnonzero(share.any(axis=0)):
                picture += share[:, k, None, None].astype(np.float32) * pictures[k]
            if camera.hand[0] <= time < camera.hand[1]:
                across = (time - camera.hand[0]) / (camera.hand[1] - camera.hand[0]) * 2 * width - width / 2
                left, right = np.clip([across, across + width / 2], 0, width).astype(int)
                picture[height // 4 :, left:right] = 0.15 + 0.1 * np.sin(np.arange(right - left))[:, None]
            noise = (0.002 + 0.006 * np.sqrt(picture)) * random.standard_normal(picture.shape, np.float32)
            code = np.round(from_light(np.clip(picture + noise, 0, 1), "srgb") * 255).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(code, format="rgb24")
            gone = camera.cut[1] - camera.cut[0] if time >= camera.cut[1] > 0 else 0
            frame.pts = round((time - times[0] - gone) / base) if camera.container != "avi" else number
            frame.time_base = base
            shown[round(frame.pts * base * TICK)] = share.mean(axis=0)
            for packet in stream.encode(frame):
                box.mux(packet)
        for packet in stream.encode():
            box.mux(packet)
    return Film(target.getvalue(), starts - times[0], shown, list(light))


def capture(
    program: Program, video: bytes, rate: float, name: str = "clip.mp4"
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The capture.json of a video, and the files beside it."""
    record = {
        "format": "envmatte-capture/1",
        "program": program.model_dump(mode="json"),
        "response": "srgb",
        "video": {"file": name, "patterns_per_second": rate},
    }
    return record, {name: video}


def turned(video: bytes, matrix: Sequence[int]) -> bytes:
    """An MP4 whose track has another display matrix (ISO/IEC 14496-12, sect. 8.3.2): what turns it upright."""
    at = video.index(b"tkhd") + 4 + 40
    return video[:at] + np.array(matrix, ">i4").tobytes() + video[at + 36 :]


def overstated(video: bytes, samples: int) -> bytes:
    """An MP4 whose index says that it has many samples, of a byte each (ISO/IEC 14496-12, sect. 8.6.1.2, 8.7)."""
    made = bytearray(video)
    for kind, at, value in (
        (b"stsz", 4, 1),
        (b"stsz", 8, samples),
        (b"stts", 8, samples),
        (b"stsc", 12, samples),
    ):
        at += made.index(kind) + 4
        made[at : at + 4] = value.to_bytes(4, "big")
    return bytes(made)


def boxes(video: bytes) -> Iterator[tuple[str, int, int]]:
    """The boxes at the top of an MP4: kind, start, size."""
    at = 0
    while at < len(video):
        size = int.from_bytes(video[at : at + 4], "big")
        yield video[at + 4 : at + 8].decode(), at, size
        at += size


def zipped(record: bytes, files: dict[str, bytes]) -> bytes:
    """A capture archive of a capture.json and files."""
    return zip_bytes({"capture.json": record, **files})
