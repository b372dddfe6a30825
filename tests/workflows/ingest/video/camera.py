"""A camera that films a monitor without being synchronised with it, and the truth about its frames."""

import io
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from tests.parts.captures import zip_bytes
from workflows.images import hdr
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
    """How a program is shown and filmed: times in seconds; ``exposure`` in frames, ``readout`` of all rows.

    ``hlg`` is the light of full scale in a film for HDR displays, 1 for their white; 0 is a film in sRGB.
    """

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
    hlg: float = 0.0
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
        if camera.hlg:
            stream.pix_fmt, stream.codec_context.color_trc = "yuv420p10le", hdr.HLG
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
            frame = _coded(picture + noise, camera)
            gone = camera.cut[1] - camera.cut[0] if time >= camera.cut[1] > 0 else 0
            frame.pts = round((time - times[0] - gone) / base) if camera.container != "avi" else number
            frame.time_base = base
            shown[round(frame.pts * base * TICK)] = share.mean(axis=0)
            for packet in stream.encode(frame):
                box.mux(packet)
        for packet in stream.encode():
            box.mux(packet)
    return Film(target.getvalue(), starts - times[0], shown, list(light))


def _coded(light: Floats, camera: Camera) -> av.VideoFrame:
    """A frame of light from 0 to 1."""
    if camera.hlg:
        of_codes = hdr.light_of_hdr(hdr.HLG)
        code = np.searchsorted(of_codes, np.clip(camera.hlg * light, 0, of_codes[-1])).astype(np.uint16)
        return av.VideoFrame.from_ndarray(code, format="rgb48le")
    code = np.round(from_light(np.clip(light, 0, 1), "srgb") * 255).astype(np.uint8)
    return av.VideoFrame.from_ndarray(code, format="rgb24")


def capture(
    program: Program, video: bytes, rate: float, name: str = "clip.mp4"
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The capture.json of a video, and the files beside it."""
    manifest = {
        "format": "envmatte-capture/1",
        "program": program.model_dump(mode="json"),
        "response": "srgb",
        "video": {"file": name, "patterns_per_second": rate},
    }
    return manifest, {name: video}


def turned(video: bytes, matrix: Sequence[int]) -> bytes:
    """An MP4 whose track has another display matrix (ISO/IEC 14496-12, sect. 8.3.2): what turns it upright."""
    at = video.index(b"tkhd") + 4 + 40
    return video[:at] + np.array(matrix, ">i4").tobytes() + video[at + 36 :]


def stated_by_container(video: bytes, *colours: int, full: bool = False) -> bytes:
    """A MOV of HEVC with a box of its colours: primaries, transfer and matrix (ISO/IEC 14496-12, sect. 12.1.5)."""
    box = struct.pack(">I4s4sHHHB", 19, b"colr", b"nclx", *colours, full << 7)
    made = bytearray(video)
    entry = made.index(b"hvc1") - 4
    end = entry + int.from_bytes(made[entry : entry + 4], "big")
    made[end:end] = box
    for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"hvc1"):
        at = made.index(kind) - 4
        made[at : at + 4] = (int.from_bytes(made[at : at + 4], "big") + len(box)).to_bytes(4, "big")
    return bytes(made)


def as_transport_stream(video: bytes, packet: int = 188) -> bytes:
    """The same pictures as a transport stream with packets of 188 bytes, or of 192 as camcorders write them."""
    target = io.BytesIO()
    options = {"mpegts_m2ts_mode": str(int(packet == 192))}
    with (
        av.open(io.BytesIO(video)) as source,
        av.open(target, "w", format="mpegts", options=options) as box,
    ):
        stream = box.add_stream_from_template(source.streams.video[0])
        for one in source.demux(source.streams.video[0]):
            if one.dts is not None:
                one.stream = stream
                box.mux(one)
    return target.getvalue()


def interlaced(top: NDArray[np.uint8], bottom: NDArray[np.uint8], count: int = 4) -> bytes:
    """An interlaced H.264 film: two pictures of (height, width, 3) codes in alternate rows."""
    height, width, _ = top.shape
    target = io.BytesIO()
    with av.open(target, "w", format="mp4") as box:
        options = {"preset": "veryfast", "qp": "1", "x264-params": "tff=1"}
        stream = box.add_stream("libx264", rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = width, 2 * height, "yuv420p"
        fields = [
            av.VideoFrame.from_ndarray(one, "rgb24").reformat(format="yuv420p").to_ndarray()
            for one in (top, bottom)
        ]
        woven = np.stack(fields, axis=1).reshape(-1, width)
        # The rows of a plane are woven by themselves: to_ndarray has one below the other, colours two rows in one.
        luma = woven[: 2 * height]
        chroma = [field[height:].reshape(2, height // 2, width // 2) for field in fields]
        colours = np.stack(chroma, axis=2).reshape(-1, width)
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(np.concatenate([luma, colours]), "yuv420p")
            frame.pts = number
            box.mux(stream.encode(frame))
        box.mux(stream.encode(None))
    return target.getvalue()


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


def zipped(manifest: bytes, files: dict[str, bytes]) -> bytes:
    """A capture archive of a capture.json and files."""
    return zip_bytes({"capture.json": manifest, **files})


def fragmented(samples: int) -> bytes:
    """An MP4 of ten fragments, of which all but the first say that they have many samples (sect. 8.8.8)."""
    target = io.BytesIO()
    flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof"}
    with av.open(target, "w", format="mp4", options=flags) as box:
        stream = box.add_stream("mjpeg", rate=Fraction(10))
        stream.width = stream.height = 64
        stream.pix_fmt = "yuvj420p"
        for n in range(10):
            box.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), 20 * n, np.uint8))))
        box.mux(stream.encode())
    made = bytearray(target.getvalue())
    at = made.index(b"trun") + 4
    while (at := made.find(b"trun", at) + 4) > 4:
        made[at : at + 8] = (1).to_bytes(4, "big") + samples.to_bytes(4, "big")
    return bytes(made)
