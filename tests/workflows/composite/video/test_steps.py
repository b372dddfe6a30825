"""Mattes before clips: real ones, encoded here."""

import hashlib
import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from storage.errors import ClipError, Corrupt
from storage.layout import composites, mattes
from storage.layout.mattes import Block, Matte
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from tests.workflows.ingest.video.camera import interlaced
from workflows.composite import composite
from workflows.composite.backdrops.around import expose, over_frame, put_around
from workflows.composite.backdrops.backdrop import Backdrop, frame_light
from workflows.composite.engine import Window
from workflows.composite.video import steps as video_steps
from workflows.composite.video.steps import STEPS
from workflows.images.tone_curves import from_light, to_light
from workflows.ingest.video.frame_means import ACCURATE
from workflows.jobs import Task, run
from workflows.untrusted.limits import Limits

LIMITS = Limits(unpacked=1 << 30, memory=1 << 26)
HEIGHT, WIDTH, COLUMNS, ROWS = 33, 45, 36, 27
TICK = Fraction(1, 600)


@pytest.fixture(autouse=True)
def short_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of 16 frames."""
    monkeypatch.setattr(video_steps, "PIXELS", 1)


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """A matte that turns a backdrop upside down; it has an odd size, and lacks a corner."""
    made = mattes.create(
        objects,
        "m",
        height=HEIGHT,
        width=WIDTH,
        columns=COLUMNS,
        rows=ROWS,
        crosstalk=np.eye(3).tolist(),
        monitor=[72, 54],
    )
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    cells = (ROWS - 1 - y * ROWS // HEIGHT) * COLUMNS + x * COLUMNS // WIDTH
    recovered = (y > 8) | (x > 8)
    for row, column in itertools.product(range(made.block_rows), range(made.block_columns)):
        at = made.span(row, column)
        seen = recovered[at]
        count = np.zeros((*seen.shape, 3), np.uint32)
        count[seen, 0] = 1
        ones = np.ones((*seen.shape, 3), np.float32)
        made.write(
            row,
            column,
            Block(
                S=0.02 * ones,
                rho=0.9 * ones,
                error=0 * ones[..., 0],
                recovered=seen,
                shared=seen,
                count=count,
                cell=cells[at][seen].astype(np.uint32),
                weight=np.ones(int(seen.sum()), np.float32),
            ),
        )
    return made


def pictures(count: int, height: int = 54, width: int = 72) -> list[NDArray[np.uint8]]:
    """Smooth pictures that move, as (height, width, 3) codes."""
    y, x = np.mgrid[:height, :width] / 72
    return [
        np.stack(
            [
                0.5 + 0.4 * np.sin(9 * x + 0.3 * n),
                0.5 + 0.4 * np.cos(7 * y - 0.2 * n),
                np.full_like(x, 0.2 + 0.6 * n / max(count, 2)),
            ],
            axis=-1,
        )
        .__mul__(255)
        .round()
        .astype(np.uint8)
        for n in range(count)
    ]


def clip(
    shown: Sequence[NDArray[np.uint8]],
    ticks: Sequence[int],
    container: str = "mp4",
    codec: str = "libx264",
    crf: str = "20",
) -> bytes:
    """A clip of pictures, each shown at a tick of 1/600 s."""
    target = io.BytesIO()
    options = {"g": "12", "crf": crf, "mbtree": "0"} if codec == "libx264" else {}
    with av.open(
        target, "w", format=container, options={"moov_size": str(max(9999, 40 * len(shown)))}
    ) as video:
        stream = video.add_stream(codec, rate=30, options=options)
        stream.height, stream.width = shown[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.time_base = TICK if codec == "libx264" else Fraction(1, 30)
        stream.codec_context.colorspace = Colorspace.ITU709
        for picture, tick in zip(shown, ticks, strict=True):
            frame = VideoFrame.from_ndarray(picture, "rgb24").reformat(
                format=stream.pix_fmt,
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.JPEG if codec == "mjpeg" else ColorRange.MPEG,
                interpolation=ACCURATE,
            )
            frame.pts, frame.time_base = (
                int(tick * TICK / stream.codec_context.time_base),
                stream.codec_context.time_base,
            )
            video.mux(stream.encode(frame))
        video.mux(stream.encode(None))
    return target.getvalue()


def even(count: int) -> list[int]:
    return [20 * n for n in range(count)]


Make = Callable[..., bytes]


@pytest.fixture
def make(objects: Objects, matte: Matte) -> Make:
    """Runs the steps of a job over a clip; returns the video."""

    def steps(
        data: bytes,
        job: str = "j",
        order: Callable[[range], Any] = iter,
        transfer: str = "srgb",
        placement: dict[str, float] | None = None,
        **options: str,
    ) -> bytes:
        objects.put(composites.clip_path(job), data)
        given = {"transfer": transfer, "placement": placement or {}, **options}
        task = Task(job, "c", "m", given, LIMITS)
        task = replace(task, plan=run(STEPS, objects, task, PREPARE)[1])
        for tile in order(range(task.plan["tiles"])):
            assert run(STEPS, objects, task, tile)[1] % (HEIGHT * WIDTH) == 0
        assert run(STEPS, objects, task, FINISH)[1] == {}
        with objects.read(composites.video_path(job)) as file:
            return file.read()

    return steps


def plan_of(objects: Objects, data: bytes, limits: Limits = LIMITS) -> dict[str, Any]:
    objects.put(composites.clip_path("p"), data)
    return video_steps.prepare(objects, Task("p", "c", "m", {}, limits))


def frames_of(video: bytes) -> tuple[list[NDArray[np.uint8]], list[Fraction], Fraction]:
    """The pictures of a video, the seconds at which they are shown, and those for which all are."""
    with av.open(io.BytesIO(video)) as container:
        stream = container.streams.video[0]
        decoded = list(container.decode(stream))
        assert stream.time_base is not None
        assert stream.duration is not None
        shown = [frame.reformat(format="rgb24", interpolation=ACCURATE).to_ndarray() for frame in decoded]
        times = [frame.pts * stream.time_base for frame in decoded if frame.pts is not None]
        return shown, times, stream.duration * stream.time_base


def test_every_frame_is_its_still_composite(make: Make, matte: Matte) -> None:
    shown = pictures(40)
    made, times, lasts = frames_of(make(clip(shown, even(40), crf="4")))
    assert times == [n * 20 * TICK for n in range(40)]
    assert lasts == 40 * 20 * TICK
    left_out = np.zeros((HEIGHT, WIDTH), bool)
    left_out[:6, :6] = True  # and not the pixels at its edge, whose colours 4:2:0 mixes
    for picture, frame in zip(shown, made, strict=True):
        assert frame.shape == (HEIGHT + 1, WIDTH + 1, 3)
        still = composite(matte, to_light(picture.astype(np.float32) / 255, "srgb"))
        expected = from_light(np.clip(still[..., :3], 0, 1), "srgb") * still[..., 3:]
        error = (frame[:HEIGHT, :WIDTH] / 255 - expected)[10:, 10:]
        assert np.sqrt(np.mean(error**2)) < 0.03
        assert frame[:HEIGHT, :WIDTH][left_out].max() < 12
        np.testing.assert_allclose(frame[-1].astype(int), frame[-2], atol=12)  # the row that makes it even


@pytest.mark.parametrize("placement", [{}, {"right": 0.2}], ids=["where the monitor was", "moved"])
def test_backdrop_is_around_the_glass(make: Make, matte: Matte, placement: dict[str, float]) -> None:
    shown = pictures(3)
    made, *_ = frames_of(make(clip(shown, even(3), crf="4"), placement=placement, around="backdrop"))
    without, *_ = frames_of(make(clip(shown, even(3), crf="4"), "k", placement=placement))
    for picture, frame, black in zip(shown, made, without, strict=True):
        light = to_light(picture.astype(np.float32) / 255, "srgb")
        moved = round(72 * placement.get("right", 0))
        light = np.pad(light, ((0, 0), (moved, 0), (0, 0)))[:, :72]
        behind = from_light(frame_light(Backdrop(light), WIDTH, HEIGHT, 1), "srgb")[:6, :6]
        assert np.sqrt(np.mean((frame[:6, :6] / 255 - behind) ** 2)) < 0.05
        assert black[:6, :6].max() < 12
        assert np.sqrt(np.mean((frame[12:].astype(float) - black[12:]) ** 2)) < 4  # the glass is the same


def test_backdrop_is_fitted_to_the_frame(make: Make, matte: Matte, objects: Objects) -> None:
    names = ("height", "width", "columns", "rows", "crosstalk", "monitor")
    beside = {"sight": [[1.5, 0, -0.25], [0, 1.5, -0.25], [0, 0, 1]], "rho": [0.8, 0.9, 0.7]}
    cut = mattes.create(objects, "m", **{name: matte.attributes[name] for name in names}, beside=beside)
    (shown,) = pictures(1)
    (made,), *_ = frames_of(make(clip([shown], [0], crf="4"), around="backdrop", fit="frame"))
    backdrop, where, window = (
        Backdrop(to_light(shown / np.float32(255), "srgb")),
        over_frame(cut, None),
        Window.of(cut),
    )
    taken = expose(cut, composite(cut, backdrop, placement=where))
    expected = from_light(put_around(cut, backdrop, where, taken, window)[..., :3], "srgb")
    assert np.sqrt(np.mean((made[:HEIGHT, :WIDTH] / 255 - expected) ** 2)) < 0.05


def test_linear_codes_are_light(make: Make, matte: Matte) -> None:
    shown = pictures(1)
    made, *_ = frames_of(make(clip(shown, [0], crf="4"), transfer="linear"))
    expected = composite(matte, shown[0].astype(np.float32) / 255)[10:, 10:, :3]
    assert np.sqrt(np.mean((made[0][10:HEIGHT, 10:WIDTH] / 255 - expected) ** 2)) < 0.03


@pytest.mark.slow
def test_order_and_repetition_of_segments_do_not_change_the_video(make: Make) -> None:
    data = clip(pictures(50), even(50))
    first = make(data)
    assert make(data, "other", lambda tiles: [*reversed(tiles), tiles[1]]) == first
    assert hashlib.sha256(make(data)).digest() == hashlib.sha256(first).digest()


def test_video_can_be_played_while_it_loads_and_states_its_colours(make: Make) -> None:
    video = make(clip(pictures(3), even(3)))
    assert video.index(b"moov") < video.index(b"mdat")
    with av.open(io.BytesIO(video)) as container:
        frame = next(container.decode(video=0))
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    assert (frame.colorspace, frame.color_primaries, frame.color_trc) == (1, 1, 1)  # BT.709
    assert frame.color_range == ColorRange.MPEG


@pytest.mark.parametrize(
    "container", ["mp4", *(pytest.param(other, marks=pytest.mark.slow) for other in ("mov", "matroska"))]
)
def test_times_are_kept_however_they_vary(make: Make, container: str) -> None:
    steps = np.random.default_rng(3).integers(1, 40, 69)
    ticks = [0, *(np.cumsum(steps) * 3).tolist()]  # of 1/200 s, which Matroska's milliseconds hold
    data = clip(pictures(70), ticks, container)
    _, times, _ = frames_of(make(data))
    assert times == [tick * TICK for tick in ticks]


@pytest.mark.parametrize(("container", "codec"), [("avi", "mjpeg"), ("avi", "mpeg4"), ("matroska", "ffv1")])
def test_other_codecs_and_containers(make: Make, container: str, codec: str) -> None:
    made, times, _ = frames_of(make(clip(pictures(20), even(20), container, codec)))
    assert len(made) == 20
    assert np.diff(np.array(times, float)) == pytest.approx(1 / 30, abs=1e-3)


def test_one_frame_is_a_video(make: Make) -> None:
    made, times, lasts = frames_of(make(clip(pictures(1), [0])))
    assert (len(made), times) == (1, [0])
    assert lasts > 0


def test_clip_that_ends_early_is_composited_to_its_end(make: Make, objects: Objects, matte: Matte) -> None:
    data = clip(pictures(80), even(80), crf="1")
    short = data[: len(data) * 5 // 8]
    for name, whole in (("mp4", data), ("mkv", clip(pictures(80), even(80), "matroska", crf="1"))):
        made, times, _ = frames_of(make(whole[: len(whole) * 5 // 8], name))
        assert 30 < len(made) < 60
        assert [round(time * 30, 1) for time in times] == [*range(len(made))]
    notes = plan_of(objects, short)["notes"]
    assert "ends early: it should be 2.666 s long" in notes[1]
    assert len(plan_of(objects, data)["notes"]) == 1


def test_where_a_clip_is_damaged_the_frame_before_stays(make: Make, objects: Objects) -> None:
    data = bytearray(clip(pictures(80), even(80), crf="1"))
    middle = (data.index(b"mdat") + len(data)) // 2
    data[middle : middle + 3000] = bytes(3000)
    _, times, lasts = frames_of(make(bytes(data)))
    assert 60 < len(times) < 80
    assert set(times) < {n * 20 * TICK for n in range(80)}
    assert lasts == 80 * 20 * TICK
    notes = plan_of(objects, bytes(data))["notes"]
    assert "can't be decoded" in notes[1]


REFUSED = {
    "empty": b"",
    "an image": b"\x89PNG\r\n\x1a\n" + bytes(4000),
    "a playlist": b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile:///etc/hostname\n#EXT-X-ENDLIST\n",
}


@pytest.mark.parametrize("kind", REFUSED)
def test_file_that_is_no_clip_is_refused(objects: Objects, matte: Matte, kind: str) -> None:
    with pytest.raises(ClipError, match="can't be read as a video"):
        plan_of(objects, REFUSED[kind])


def test_frames_larger_than_the_limit_are_refused(objects: Objects, matte: Matte) -> None:
    with pytest.raises(ClipError, match="72 x 54 pixels") as caught:
        plan_of(objects, clip(pictures(1), [0]), Limits(unpacked=1 << 30, memory=4 * 72 * 54 * 6 - 4))
    assert caught.value.fields == {"limit": 72 * 54 * 6 - 1}


def test_frame_shown_for_days_is_refused(objects: Objects, matte: Matte) -> None:
    with pytest.raises(ClipError, match="frame 1 of the clip is shown for"):
        plan_of(objects, clip(pictures(3), [0, 20, 600 * 86400 * 5], "matroska"))


def test_more_frames_than_are_taken_are_refused(
    objects: Objects, matte: Matte, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video_steps, "MOST", 9)
    with pytest.raises(ClipError, match="more than 9 frames"):
        plan_of(objects, clip(pictures(10), even(10)))


def test_missing_segment_is_named_and_repeated(make: Make, objects: Objects) -> None:
    data = clip(pictures(50), even(50))
    whole = make(data)
    task = Task("j", "c", "m", {"transfer": "srgb", "placement": {}}, LIMITS)
    task = replace(task, plan=run(STEPS, objects, task, PREPARE)[1])
    objects.delete(composites.segment_path("j", 1))
    assert run(STEPS, objects, task, FINISH)[1] == {"missing": [1]}
    run(STEPS, objects, task, 1)
    run(STEPS, objects, task, FINISH)
    with objects.read(composites.video_path("j")) as file:
        assert file.read() == whole


def test_deleted_clip_is_reported(make: Make, objects: Objects) -> None:
    make(clip(pictures(2), even(2)))
    composites.remove_inputs(objects, "j")
    assert objects.names(composites.path("j")) == [composites.VIDEO]
    with pytest.raises(Corrupt, match="send it again"):
        video_steps.prepare(objects, Task("j", "c", "m", {}, LIMITS))


def test_interlaced_clip_is_refused_with_a_remedy(objects: Objects, matte: Matte) -> None:
    one, other = pictures(2, 24, 64)
    with pytest.raises(ClipError, match=r"the clip is interlaced: .* Deinterlace it with a video editor"):
        plan_of(objects, interlaced(one, other))
