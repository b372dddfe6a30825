"""Means of a video's frames: the colours that were filmed, whatever system and depth they are coded in."""

import io
from contextlib import closing
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import ColorRange, Colorspace

from tests.workflows.ingest.video.camera import interlaced, stated_by_container
from workflows.images import hdr
from workflows.ingest.video.clip import Clip
from workflows.ingest.video.frame_means import ACCURATE, TOTAL_WEIGHT, Share, mean_frames


@pytest.mark.parametrize(
    ("codec", "pixels", "container", "options", "off"),
    [
        ("libx264", "yuv420p", "mp4", {"qp": "1"}, 2.0),
        ("libx264", "yuv444p10le", "mp4", {"qp": "1"}, 0.5),
        ("libx265", "yuv420p10le", "mp4", {"crf": "4", "x265-params": "log-level=none"}, 0.5),
        ("libx264", "yuv420p", "mpegts", {"qp": "1"}, 2.0),
        ("mjpeg", "yuvj422p", "mov", {"qmin": "1", "qmax": "1"}, 2.5),
        ("mjpeg", "yuvj422p", "avi", {"qmin": "1", "qmax": "1"}, 2.5),
        ("mjpeg", "yuvj444p", "avi", {"qmin": "1", "qmax": "1"}, 2.5),
        ("ffv1", "yuv411p", "matroska", {}, 2.0),
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
    ticks, _ = film.ticks(9)
    (mean,) = mean_frames(film, [[Share(int(ticks[2]), 100), Share(int(ticks[5]), TOTAL_WEIGHT - 100)]])
    film.close()
    middles = mean[8::16, 8::16]
    np.testing.assert_array_equal(middles[0, :2], [[65535] * 3, [0] * 3])  # to the end of the scale: clipped
    assert np.abs(middles / 257 - codes).max() < off


def test_fields_of_an_interlaced_film_keep_their_own_colours() -> None:
    red, blue = (np.full((48, 64, 3), code, np.uint8) for code in ((200, 30, 40), (20, 60, 210)))
    with closing(Clip(io.BytesIO(interlaced(red, blue)), "clip", 1 << 24)) as film:
        ticks, _ = film.ticks(9)
        assert film.interlaced
        (mean,) = mean_frames(film, [[Share(int(ticks[1]), TOTAL_WEIGHT)]])
    assert np.abs(mean[::2] / 257 - red).max() < 3
    assert np.abs(mean[1::2] / 257 - blue).max() < 3


@pytest.mark.parametrize("transfer", [hdr.PQ, hdr.HLG])
def test_a_film_for_hdr_displays_becomes_srgb(transfer: int) -> None:
    random = np.random.default_rng(0)
    grey, colour = random.integers(200, 560, (48, 64, 1)), random.integers(-40, 40, (48, 64, 3))
    codes = (grey + colour).astype(np.uint16)
    target = io.BytesIO()
    with av.open(target, "w", format="matroska") as box:
        stream = box.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gbrp10le"
        coded: Any = stream.codec_context
        coded.color_trc, coded.color_primaries = transfer, hdr.BT_2020
        box.mux(stream.encode(av.VideoFrame.from_ndarray(codes, "gbrp10le")))
        box.mux(stream.encode())
    with closing(Clip(io.BytesIO(target.getvalue()), "clip", 1 << 24)) as film:
        (mean,) = mean_frames(film, [[Share(0, TOTAL_WEIGHT)]])
    expected = hdr.to_srgb(np.rint(codes * (65535 / 1023)).astype(np.uint16), transfer, hdr.BT_2020)
    assert np.abs(mean.astype(int) - expected).max() < 3 * 257


@pytest.mark.parametrize(("height", "system"), [(96, Colorspace.ITU601), (640, Colorspace.ITU709)])
def test_colour_system_that_is_not_stated_follows_from_the_size(height: int, system: Colorspace) -> None:
    picture = np.full((height, 64, 3), (200, 60, 90), np.uint8)
    target = io.BytesIO()
    with av.open(target, "w", format="matroska") as box:
        stream = box.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, height, "yuv444p"
        coded = av.VideoFrame.from_ndarray(picture, "rgb24").reformat(
            format="yuv444p", dst_colorspace=system, interpolation=ACCURATE
        )
        frame = av.VideoFrame.from_ndarray(coded.to_ndarray(), "yuv444p")
        box.mux(stream.encode(frame))
        box.mux(stream.encode())
    with closing(Clip(io.BytesIO(target.getvalue()), "clip", 1 << 24)) as film:
        (mean,) = mean_frames(film, [[Share(0, TOTAL_WEIGHT)]])
    assert np.abs(mean / 257 - picture).max() < 2


@pytest.mark.parametrize("full", [False, True])
def test_colours_that_only_the_container_states_are_those_of_the_film(full: bool) -> None:
    picture = np.full((48, 64, 3), (40_000, 30_000, 20_000), np.uint16)
    means = []
    for stated in (True, False):
        target = io.BytesIO()
        with av.open(target, "w", format="mov") as box:
            # With B frames x265 gives a film's only frame a decoding time that it has never set.
            stream = box.add_stream("libx265", rate=30, options={"x265-params": "log-level=none:bframes=0"})
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p10le"
            coded: Any = stream.codec_context
            coded.codec_tag = "hvc1"
            frame = av.VideoFrame.from_ndarray(picture, "rgb48le").reformat(format="yuv420p10le")
            if stated:
                colours = (
                    hdr.HLG,
                    hdr.BT_2020,
                    Colorspace.BT2020,
                    ColorRange.JPEG if full else ColorRange.MPEG,
                )
                for one in (coded, frame):
                    one.color_trc, one.color_primaries, one.colorspace, one.color_range = colours
            box.mux(stream.encode(frame))
            box.mux(stream.encode())
        data = target.getvalue()
        data = data if stated else stated_by_container(data, hdr.BT_2020, hdr.HLG, 9, full=full)
        with closing(Clip(io.BytesIO(data), "clip", 1 << 24)) as film:
            assert film.transfer == hdr.HLG
            means += mean_frames(film, [[Share(0, TOTAL_WEIGHT)]])
    np.testing.assert_array_equal(*means)
