"""A video is opened with bounds and decoded upright; damage and other files are refused or cost single patterns."""

import gc
import io
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import av
import numpy as np
import pytest

from storage.errors import CaptureError
from tests.parts.inputs.heics import heic
from tests.workflows.composite.video.test_steps import clip, even, pictures
from tests.workflows.ingest.video.camera import Camera, Film, as_transport_stream, boxes, film, turned
from tests.workflows.ingest.video.films import IngestFilm, error_of, misplaced, missing
from workflows.ingest.video.clip import Clip
from workflows.ingest.video.frame_means import TOTAL_WEIGHT, Share, mean_frames

TURNS = {
    90: (0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30),
    180: (-1 << 16, 0, 0, 0, -1 << 16, 0, 0, 0, 1 << 30),
    270: (0, -1 << 16, 0, 1 << 16, 0, 0, 0, 0, 1 << 30),
}


@pytest.mark.parametrize(
    "clockwise", [90, *(pytest.param(turn, marks=pytest.mark.slow) for turn in TURNS if turn != 90)]
)
def test_a_video_is_turned_upright(ingest_film: IngestFilm, filmed: Film, clockwise: int) -> None:
    flat = ingest_film(filmed.data).read()
    stack = ingest_film(turned(filmed.data, TURNS[clockwise]))
    np.testing.assert_array_equal(stack.read(), np.rot90(flat, -clockwise // 90, axes=(1, 2)))
    assert misplaced(stack, filmed) == []


REFUSED: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut off": (lambda video: video[: len(video) // 2], "cut off or damaged"),
    "empty": (lambda video: b"", "can't be read"),
    "no video": (lambda video: b"\x89PNG\r\n" + bytes(5000), "can't be read"),
    "a playlist": (
        lambda video: b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile:///etc/hostname\n#EXT-X-ENDLIST\n",
        "can't be read",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_file_that_is_no_whole_video_is_refused(ingest_film: IngestFilm, filmed: Film, case: str) -> None:
    change, reason = REFUSED[case]
    with pytest.raises(CaptureError, match=reason) as caught:
        ingest_film(change(filmed.data))
    assert caught.value.fields["entry"] == "clip.mp4"


@pytest.mark.slow
def test_damaged_stretch_costs_only_its_patterns(ingest_film: IngestFilm, filmed: Film) -> None:
    kind, start, size = max(boxes(filmed.data), key=lambda box: box[2])
    assert kind == "mdat"
    video = bytearray(filmed.data)
    video[start + size // 2 : start + size // 2 + 2000] = bytes(2000)
    stack = ingest_film(bytes(video))
    assert missing(stack)
    assert error_of(stack, filmed) < 6


def test_frames_larger_than_the_limit_are_refused(ingest_film: IngestFilm, filmed: Film) -> None:
    with pytest.raises(CaptureError, match="96 x 72 pixels") as caught:
        ingest_film(filmed.data, memory=4 * 96 * 72 * 6 - 4)
    assert caught.value.fields == {"entry": "clip.mp4", "limit": 96 * 72 * 6 - 1}


@pytest.mark.parametrize("packet", [188, 192])
def test_frames_of_a_transport_stream_are_found_from_any_time(packet: int) -> None:
    """It has no index, and where it is entered nothing can be decoded up to the next key frame."""
    mp4 = clip(pictures(90), even(90))  # a key frame each 12
    stream = as_transport_stream(mp4, packet)
    with closing(Clip(io.BytesIO(mp4), "clip", 1 << 24)) as plain:
        expected, _ = plain.ticks(99)
        first = plain.time_base
    with closing(Clip(io.BytesIO(stream), "clip", 1 << 24)) as opened:
        ticks, _ = opened.ticks(99)
        steps = np.diff(ticks) * float(opened.time_base)
    np.testing.assert_allclose(steps, np.diff(expected) * float(first), atol=1e-9)
    shares = [[Share(tick, TOTAL_WEIGHT)] for tick in ticks.tolist()]
    with closing(Clip(io.BytesIO(stream), "clip", 1 << 24)) as opened:
        pixels = list(mean_frames(opened, shares))
        for at in (89, 40, 12, 0, 77):
            (again,) = mean_frames(opened, shares[at : at + 1])
            np.testing.assert_array_equal(again, pixels[at])


@pytest.mark.slow
def test_a_film_in_a_transport_stream_is_ingested_as_in_any_container(
    ingest_film: IngestFilm, filmed: Film
) -> None:
    stack = ingest_film(as_transport_stream(filmed.data, 192))
    assert missing(stack) == []
    assert error_of(stack, filmed) < 6


def test_codec_that_is_not_read_is_named_with_a_remedy() -> None:
    data = clip(pictures(3), even(3), container="avi", codec="msmpeg4")
    with pytest.raises(CaptureError, match=r"^clip is coded by msmpeg4: export it as H\.264, HEVC or MJPEG"):
        Clip(io.BytesIO(data), "clip", 1 << 24)


def test_picture_is_no_film_of_one_frame() -> None:
    picture = heic(np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(CaptureError, match=r"IMG_1\.HEIC is a picture in HEIC, not a film"):
        Clip(io.BytesIO(picture), "IMG_1.HEIC", 1 << 20)


@pytest.mark.parametrize("count", [1, 20])
def test_cover_or_preview_before_the_film_is_left_out(count: int) -> None:
    frames = pictures(20)
    target = io.BytesIO()
    with av.open(target, "w", format="matroska") as box:
        cover, film = box.add_stream("mjpeg", rate=10), box.add_stream("libx264", rate=10)
        cover.width, cover.height, cover.pix_fmt = 16, 12, "yuvj420p"
        film.height, film.width = frames[0].shape[:2]
        film.pix_fmt = "yuv420p"
        for stream, shown in ((cover, [np.zeros((12, 16, 3), np.uint8)] * count), (film, frames)):
            for picture in shown:
                box.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            box.mux(stream.encode(None))
    with closing(Clip(target, "clip", 1 << 24)) as read:
        assert read.size == (film.width, film.height)
        assert len(list(read.frames())) == len(frames)


@pytest.mark.slow
def test_frames_larger_than_the_container_says_are_never_decoded(ingest_film: IngestFilm) -> None:
    large = np.full((2400, 3200, 3), 0.5, np.float32)
    bomb = bytearray(film([large] * 2, Camera(fps=24, hold=0.1, lead=0, tail=0)).data)
    at = bomb.index(b"avc1") + 4 + 24  # width and height of the sample entry
    bomb[at : at + 4] = (96).to_bytes(2, "big") + (72).to_bytes(2, "big")
    with pytest.raises(CaptureError) as caught:
        ingest_film(bytes(bomb), memory=1 << 24)
    assert caught.value.fields["entry"] == "clip.mp4"


def decoding() -> list[str]:
    """The threads of this process that decode."""
    names = [task.read_text() for task in Path("/proc/self/task").glob("*/comm")]
    return [name for name in names if name.startswith("av:")]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are looked up in /proc")
def test_closed_clip_leaves_no_decoder() -> None:
    """It doesn't wait for the garbage collector: each decoder has threads, and frames of tens of megabytes."""
    data = clip(pictures(20), even(20))
    gc.collect()
    before = decoding()
    gc.disable()
    try:
        for used in (True, False):
            opened = Clip(io.BytesIO(data), "clip", 1 << 24)
            if used:
                ticks, _ = opened.ticks(99)
                list(mean_frames(opened, [[Share(tick, TOTAL_WEIGHT)] for tick in ticks[:5].tolist()]))
            assert len(decoding()) > len(before)
            opened.close()
            del opened
            assert decoding() == before
        with pytest.raises(CaptureError):
            Clip(io.BytesIO(data), "clip", 1000)
        assert decoding() == before
    finally:
        gc.enable()
