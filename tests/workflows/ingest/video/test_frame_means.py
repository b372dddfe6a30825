"""Means of a video's frames: the colours that were filmed, whatever system and depth they are coded in."""

import io

import av
import numpy as np
import pytest

from workflows.ingest.video.decoder import Clip
from workflows.ingest.video.frame_means import TOTAL_WEIGHT, Share, mean_frames
from workflows.ingest.video.signatures import take_signatures


@pytest.mark.parametrize(
    ("codec", "pixels", "container", "options", "off"),
    [
        ("libx264", "yuv420p", "mp4", {"qp": "1"}, 2.0),
        ("libx264", "yuv444p10le", "mp4", {"qp": "1"}, 0.5),
        ("libx265", "yuv420p10le", "mp4", {"crf": "4", "x265-params": "log-level=none"}, 0.5),
        ("mjpeg", "yuvj422p", "mov", {"qmin": "1", "qmax": "1"}, 2.5),
        ("ffv1", "bgr0", "matroska", {}, 0.2),
        ("ffv1", "gbrp10le", "matroska", {}, 0.2),
        ("prores_ks", "yuv422p10le", "mov", {}, 0.5),
    ],
)
def test_a_mean_has_the_colours_that_were_filmed(
    codec: str, pixels: str, container: str, options: dict[str, str], off: float
) -> None:
    random = np.random.Generator(np.random.PCG64(0))
    codes = random.integers(0, 256, (6, 8, 3), np.uint8)
    codes[0, :2] = [[255, 255, 255], [0, 0, 0]]
    picture = codes.repeat(16, axis=0).repeat(16, axis=1)
    target = io.BytesIO()
    with av.open(target, "w", format=container) as box:
        stream = box.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.options = 128, 96, pixels, options
        for number in range(8):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = number
            box.mux(stream.encode(frame))
        box.mux(stream.encode())
    film = Clip(io.BytesIO(target.getvalue()), "clip", 1 << 24)
    _, ticks, _ = take_signatures(film, 1 << 24)
    (mean,) = mean_frames(film, [[Share(int(ticks[2]), 100), Share(int(ticks[5]), TOTAL_WEIGHT - 100)]])
    film.close()
    middles = mean[8::16, 8::16]
    np.testing.assert_array_equal(middles[0, :2], [[65535] * 3, [0] * 3])  # to the end of the scale: clipped
    assert np.abs(middles / 257 - codes).max() < off
