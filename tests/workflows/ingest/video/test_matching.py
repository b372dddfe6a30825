"""A video capture: every pattern from the right frames, whatever the camera, and what can't be used is refused."""

import sys
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from storage.errors import CaptureError
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.parts.captures import nested_program
from tests.workflows.ingest import peak
from tests.workflows.ingest.video.camera import TICK, Camera, Film, boxes, capture, film, lights, turned
from workflows.images.tone_curves import from_light
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball

Zip = Callable[..., bytes]
Ingest = Callable[..., Stack]
Digests = Callable[[str], dict[str, str]]
PROGRAM = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 12), (32, 24, 6)), levels=5)
CAMERA = Camera()


@pytest.fixture(scope="module")
def light() -> list[np.ndarray]:
    return lights(glass_ball(96, 72, monitor=(64, 48), rays=16), PROGRAM)


@pytest.fixture(scope="module")
def filmed(light: list[np.ndarray]) -> Film:
    return film(light, CAMERA)


@pytest.fixture
def take(make_zip: Zip, ingest: Ingest) -> Callable[..., Stack]:
    """Ingests a video as a capture of the program."""

    def run(video: bytes, rate: float = 1 / CAMERA.hold, program: Program = PROGRAM, **more: Any) -> Stack:
        pack = {"pack": more.pop("pack")} if "pack" in more else {}
        return ingest("c", make_zip(*capture(program, video, rate), **pack), **more)

    return run


def wrong(stack: Stack, film: Film) -> list[tuple[int, int]]:
    """The shares of frames that show something else than their pattern."""
    patterns = stack.attributes["patterns"]
    rows = stack.shares()
    assert (np.bincount(rows[:, 0], rows[:, 2]) == 257).all()
    times = np.array(sorted(film.shown))
    found = []
    for at, tick, _ in rows.tolist():
        time = times[np.abs(times - tick * stack.attributes["video"]["tick"] * TICK).argmin()]
        if film.shown[int(time)][patterns[at]] < 0.97:
            found.append((patterns[at], int(time)))
    return found


def missing(stack: Stack) -> list[int]:
    assert sorted({*stack.attributes["patterns"], *map(int, stack.attributes["video"]["missing"])}) == list(
        range(PROGRAM.count)
    )
    return [int(number) for number in stack.attributes["video"]["missing"]]


def error_of(stack: Stack, film: Film) -> float:
    """Root of the mean square error of the mean frames, in 8-bit codes."""
    true = [from_light(np.clip(film.light[n], 0, 1), "srgb") for n in stack.attributes["patterns"]]
    return float(np.sqrt(np.mean((stack.read() / 257 - 255 * np.stack(true)) ** 2)))


@pytest.mark.parametrize(
    "camera",
    [
        Camera(),
        pytest.param(Camera(fps=24, exposure=1.0, seed=1), marks=pytest.mark.exhaustive),
        pytest.param(Camera(fps=25, exposure=1.0, hold=0.4, seed=2), marks=pytest.mark.exhaustive),
        pytest.param(Camera(fps=60, hold=0.1, seed=3), marks=pytest.mark.slow),
        pytest.param(Camera(fps=60, hold=0.15, exposure=1.0, seed=4), marks=pytest.mark.exhaustive),
        pytest.param(Camera(fps=120, hold=0.2, readout=0.008, seed=5), marks=pytest.mark.slow),
        Camera(fps=30000 / 1001, uneven=0.6, seed=6),
        pytest.param(Camera(fps=30, jitter=0.03, readout=0.033, seed=7), marks=pytest.mark.slow),
        pytest.param(Camera(codec="libx265", seed=8), marks=pytest.mark.slow),
        pytest.param(Camera(codec="mjpeg", container="mov", seed=9), marks=pytest.mark.exhaustive),
        Camera(codec="mjpeg", container="avi", seed=10),
        pytest.param(Camera(container="matroska", seed=11), marks=pytest.mark.slow),
        pytest.param(Camera(idle=0.0, lead=1.3, seed=12), marks=pytest.mark.exhaustive),
        pytest.param(Camera(lead=0.1, tail=0.1, seed=13), marks=pytest.mark.slow),
        pytest.param(Camera(options={"g": "7", "bf": "2"}, seed=14), marks=pytest.mark.slow),
        pytest.param(Camera(options={"crf": "30"}, seed=15), marks=pytest.mark.exhaustive),
    ],
    ids=str,
)
def test_every_pattern_is_found(take: Callable[..., Stack], light: list[np.ndarray], camera: Camera) -> None:
    made = film(light, camera)
    stack = take(made.data, 1 / camera.hold)
    assert wrong(stack, made) == []
    assert missing(stack) == []
    assert stack.dtype == np.uint16
    assert error_of(stack, made) < (8 if camera.options.get("crf") else 3)
    found = stack.attributes["video"]
    assert found["frames"] == len(made.shown)
    assert found["patterns_per_second"] == pytest.approx(1 / camera.hold, rel=0.1)
    if camera.idle:
        assert found["first_pattern_seconds"] == pytest.approx(made.starts[0], abs=0.5 * camera.hold)


@pytest.mark.slow
@pytest.mark.parametrize("pack", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_the_bytes_are_the_same_whatever_the_slabs(
    take: Callable[..., Stack], digests: Digests, light: list[np.ndarray], pack: int
) -> None:
    made = film(light, Camera(fps=24, hold=0.2, readout=0.005, options={"g": "12", "bf": "3"}))
    whole, stored = take(made.data, 5, pack=pack).read(), []
    assert len(whole) == PROGRAM.count
    for order in (iter, reversed):
        memory = len(made.shown) * 24 * 32 * 3 * 4  # what sorting takes
        assert memory // (2 * whole[0].nbytes) < len(whole)  # several slabs
        few = take(made.data, 5, pack=pack, memory=memory, order=order)
        np.testing.assert_array_equal(few.read(), whole)
        stored.append(digests("captures/c"))
    assert stored[0] == stored[1]


TURNS = {
    90: (0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30),
    180: (-1 << 16, 0, 0, 0, -1 << 16, 0, 0, 0, 1 << 30),
    270: (0, -1 << 16, 0, 1 << 16, 0, 0, 0, 0, 1 << 30),
}


@pytest.mark.parametrize("clockwise", TURNS)
def test_a_video_is_turned_upright(take: Callable[..., Stack], filmed: Film, clockwise: int) -> None:
    flat = take(filmed.data).read()
    stack = take(turned(filmed.data, TURNS[clockwise]))
    np.testing.assert_array_equal(stack.read(), np.rot90(flat, -clockwise // 90, axes=(1, 2)))
    assert wrong(stack, filmed) == []


def test_the_monitor_may_show_the_first_pattern_before(
    take: Callable[..., Stack], light: list[np.ndarray]
) -> None:
    # nothing shows where the first pattern begins, which is as black as the monitor was before
    made = film([0 * light[0], *light[1:]], Camera(idle=0.0, seed=3))
    stack = take(made.data)
    assert missing(stack) == []
    assert wrong(stack, made) == []


def test_patterns_alike_are_told_by_their_time(take: Callable[..., Stack], light: list[np.ndarray]) -> None:
    record = PROGRAM.model_dump(mode="json")
    record["parts"][0]["levels"] = [0.0, 1.0, 1.0, 0.5, 0.5]
    program = Program.model_validate(record)
    made = film([light[0], light[4], light[4], light[2], light[2], *light[5:]], CAMERA)
    stack = take(made.data, program=program)
    assert missing(stack) == []
    assert [pattern for pattern, _ in wrong(stack, made) if pattern not in (1, 2, 3, 4)] == []


@pytest.mark.slow
def test_a_hand_in_front_costs_the_patterns_behind_it(
    take: Callable[..., Stack], light: list[np.ndarray]
) -> None:
    for seed in range(3):
        made = film(light, Camera(hand=(5.0, 6.0), seed=seed))
        stack = take(made.data)
        behind = np.flatnonzero((made.starts[1:] > 5.0) & (made.starts[:-1] < 6.0)).tolist()
        assert wrong(stack, made) == []
        assert len(missing(stack)) >= 2
        assert set(missing(stack)) <= set(behind)
        assert error_of(stack, made) < 3


@pytest.mark.parametrize(("camera", "lost"), [(Camera(tail=-1.5), "ends"), (Camera(cut=(-1, 1.8)), "begins")])
def test_a_recording_of_a_part_of_the_program(
    take: Callable[..., Stack], light: list[np.ndarray], camera: Camera, lost: str
) -> None:
    made = film(light, camera)
    if lost == "begins":  # without black there is no S
        with pytest.raises(CaptureError, match=r"constant patterns are not both found.*begins after"):
            take(made.data)
        return
    stack = take(made.data)
    assert wrong(stack, made) == []
    assert 4 <= len(missing(stack)) <= 7
    assert missing(stack)[-1] == PROGRAM.count - 1
    assert stack.attributes["video"]["missing"][str(PROGRAM.count - 1)] == "the recording ends before it"


def other(**changes: Any) -> Program:
    record = PROGRAM.model_dump(mode="json")
    for name, value in changes.items():
        for part in record["parts"][1:]:
            part[name] = value
    return Program.model_validate(record)


REFUSED: dict[str, tuple[Camera | Callable[[bytes], bytes], Program, str]] = {
    "of another program": (CAMERA, other(seed=1), "does not look like the patterns"),
    "of fewer patterns": (CAMERA, other(count=30), "do not fit|begins after|are found"),
    "of more patterns": (CAMERA, other(count=4), "do not fit|does not look"),
    "cut in the middle": (Camera(cut=(5.0, 7.0)), PROGRAM, "do not fit|does not look|are found"),
    "shown too fast": (Camera(fps=24, hold=0.06), PROGRAM, "never stands still"),
    "cut off": (lambda video: video[: len(video) // 2], PROGRAM, "cut off or damaged"),
    "empty": (lambda video: b"", PROGRAM, "can't be read"),
    "no video": (lambda video: b"\x89PNG\r\n" + bytes(5000), PROGRAM, "can't be read"),
    "a playlist": (
        lambda video: b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile:///etc/hostname\n#EXT-X-ENDLIST\n",
        PROGRAM,
        "can't be read",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_does_not_fit_is_refused(
    take: Callable[..., Stack], light: list[np.ndarray], filmed: Film, kind: str
) -> None:
    change, program, why = REFUSED[kind]
    if isinstance(change, Camera):
        video, rate = film(light, change).data, 1 / change.hold
    else:
        video, rate = change(filmed.data), 1 / CAMERA.hold
    with pytest.raises(CaptureError, match=why) as caught:
        take(video, rate, program)
    assert caught.value.fields["entry"] == "clip.mp4"


def test_a_video_of_nothing_is_refused(take: Callable[..., Stack], light: list[np.ndarray]) -> None:
    with pytest.raises(CaptureError, match="nothing changes"):
        take(film([light[3]] * 20, Camera(idle=1.0)).data)


def test_a_stretch_that_is_damaged_costs_its_patterns(take: Callable[..., Stack], filmed: Film) -> None:
    kind, start, size = max(boxes(filmed.data), key=lambda box: box[2])
    assert kind == "mdat"
    video = bytearray(filmed.data)
    video[start + size // 2 : start + size // 2 + 2000] = bytes(2000)
    stack = take(bytes(video))
    assert missing(stack)
    assert error_of(stack, filmed) < 6


def test_frames_larger_than_the_limit_are_refused(take: Callable[..., Stack], filmed: Film) -> None:
    with pytest.raises(CaptureError, match="96 x 72 pixels") as caught:
        take(filmed.data, memory=4 * 96 * 72 * 6 - 4)
    assert caught.value.fields == {"entry": "clip.mp4", "limit": 96 * 72 * 6 - 1}


@pytest.mark.slow
def test_frames_larger_than_the_container_says_are_never_decoded(
    take: Callable[..., Stack], light: list[np.ndarray]
) -> None:
    large = np.full((2400, 3200, 3), 0.5, np.float32)
    bomb = bytearray(film([large] * 2, Camera(fps=24, hold=0.1, lead=0, tail=0)).data)
    at = bomb.index(b"avc1") + 4 + 24  # width and height of the sample entry
    bomb[at : at + 4] = (96).to_bytes(2, "big") + (72).to_bytes(2, "big")
    with pytest.raises(CaptureError) as caught:
        take(bytes(bomb), memory=1 << 24)
    assert caught.value.fields["entry"] == "clip.mp4"


def test_more_patterns_than_are_sorted_are_refused(take: Callable[..., Stack], filmed: Film) -> None:
    with pytest.raises(CaptureError, match="more than the 2000") as caught:
        take(filmed.data, program=other(count=700))
    assert caught.value.fields == {"entry": "clip.mp4", "limit": 2000}


def test_more_frames_than_are_sorted_are_refused(take: Callable[..., Stack], filmed: Film) -> None:
    with pytest.raises(CaptureError, match="the most that can be matched"):
        take(filmed.data, memory=1 << 20)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the resident peak is read from Linux's /proc")
def test_a_long_video_takes_no_more_memory_than_is_allowed(
    make_zip: Zip, put: Callable[[str, bytes], None], objects: Objects, light: list[np.ndarray]
) -> None:
    memory, rate = 64 << 20, 1 / CAMERA.hold
    coarse = [np.kron(picture, np.ones((4, 4, 1), np.float32)) for picture in light]
    for name, camera in {
        "small": Camera(options={"g": "20"}),
        "large": Camera(fps=90, options={"g": "20"}),
    }.items():
        made = film(coarse, camera)
        put(name, make_zip(*capture(PROGRAM, made.data, rate)))
    decoded = len(made.shown) * coarse[0].size
    assert decoded > 4 * memory
    _, grown = peak.of_large_after_small(objects, memory)
    assert grown <= memory // 2  # eight times less than the frames, decoded
