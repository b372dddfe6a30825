"""A program's video: pictures and times are exact when it is decoded, and ingest finds every pattern in it."""

import io
import json
import zipfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from storage.errors import CaptureError, OptionError
from storage.layout import uploads
from storage.layout.captures import Stack
from storage.objects.store import Objects
from workflows.ingest import steps
from workflows.ingest.video.matching import MIN_RESEMBLANCE
from workflows.jobs import Task
from workflows.programs.border import LEAD_SECONDS, Border, draw_border, schedule
from workflows.programs.files import fit_to_screen, pictures
from workflows.programs.parts import Bernoulli, Constant, Monitor
from workflows.programs.program import Program
from workflows.programs.video import write_video
from workflows.untrusted.limits import Limits

LEVELS = Constant(kind="constant", levels=(0, 0.25, 0.5, 0.75, 1))
RANDOM = Bernoulli(kind="bernoulli", columns=64, rows=48, count=6, seed=3, offset=True)
GREY = Program(monitor=Monitor(width=271, height=199), parts=(LEVELS, RANDOM))  # odd sizes
RATE = 2.0
COLOURED = fit_to_screen("sketch", (320, 240), bordered=True)


@pytest.mark.parametrize("end", [".mp4", ".mkv"])
@pytest.mark.parametrize(("program", "off"), [(GREY, 0), (COLOURED, 1)], ids=["grey", "coloured"])
@pytest.mark.parametrize("rate", [2.0, 7.5])
def test_every_picture_is_shown_for_its_time(
    program: Program, off: int, end: str, rate: float, tmp_path: Path
) -> None:
    path = tmp_path / f"film{end}"
    write_video(program, path, rate, lambda done, of: None)
    border = Border.around(program.monitor.width, program.monitor.height)
    of_patterns = list(pictures(program))
    steps = schedule(program.count, rate)
    with av.open(path) as video:
        stream = video.streams.video[0]
        frames = [
            (float(Fraction(frame.pts) * frame.time_base), frame.to_ndarray(format="rgb24"))
            for frame in video.decode(stream)
        ]
        context = stream.codec_context
        assert (context.color_range, context.colorspace) == (ColorRange.JPEG, Colorspace.ITU709)
        assert (context.color_primaries, context.color_trc) == (ColorPrimaries.BT709, ColorTrc.IEC61966_2_1)
        spacing = float(1 / stream.average_rate)
    times = np.array([time for time, _ in frames])
    start = 0.0
    for step in steps:
        level = np.full((1, 1, 1), 255 * step.white, np.uint8)
        picture = draw_border(level if step.number < 0 else of_patterns[step.number], step.number, border)
        within = [
            frame
            for time, frame in frames
            if start - 1e-2 * spacing <= time - times[0] < start + step.seconds / 2
        ]
        assert within
        for frame in within:
            assert np.abs(frame.astype(int) - picture).max() <= off
        lasts = step.seconds if step.number >= 0 else round(step.seconds / spacing) * spacing
        start += lasts
    assert times[-1] - times[0] + spacing == pytest.approx(start, abs=2e-3)
    assert start == pytest.approx(2 * sum(LEAD_SECONDS) + program.count / rate, abs=10 * spacing)


def test_manifest_beside_the_video_is_a_valid_capture_json(tmp_path: Path) -> None:
    write_video(COLOURED, tmp_path / "sketch.mp4", 3.0, lambda done, of: None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sketch.json", "sketch.mp4"]
    record = json.loads((tmp_path / "sketch.json").read_text())
    assert record["format"] == "envmatte-capture/1"
    assert Program.model_validate(record["program"]) == COLOURED
    assert record["video"]["patterns_per_second"] == 3
    assert Border.model_validate(record["video"]["border"]) == Border(width=320, height=240)


def test_the_same_program_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        write_video(COLOURED, tmp_path / name, 2.0, lambda done, of: None)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.parametrize("name", ["film.mp4", "film.json"])
def test_existing_file_is_kept(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(OptionError, match=f"{name} exists already"):
        write_video(COLOURED, tmp_path / "film.mp4", 2.0, lambda done, of: None)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("program", "rate", "reason"),
    [
        (GREY, 0.0, "0.0 patterns a second"),
        (GREY, float("nan"), "nan patterns a second"),
        (fit_to_screen("sketch", (40, 30), bordered=False), 2.0, "no border can be drawn"),
        (
            Program(monitor=GREY.monitor, parts=(LEVELS, RANDOM.model_copy(update={"count": 4091}))),
            2.0,
            "4096 patterns",
        ),
    ],
    ids=["rate", "nan", "border", "patterns"],
)
def test_program_that_cannot_be_filmed_is_refused_and_leaves_nothing(
    program: Program, rate: float, reason: str, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=reason):
        write_video(program, tmp_path / "new" / "film.mkv", rate, lambda done, of: None)
    assert not list(tmp_path.rglob("*.*"))


def prepare_film(folder: Path) -> Stack:
    """Prepare a capture of `film.mp4` and `film.json`, as if a camera had seen exactly the display."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.write(folder / "film.json", "capture.json")
        archive.write(folder / "film.mp4", "film.mp4")
    objects = Objects((folder / "store").as_uri())
    objects.put(uploads.part_path("c", "all"), target.getvalue())
    uploads.seal(objects, "c", [uploads.Part("all", len(target.getvalue()))])
    steps.prepare(objects, Task("j", "c", "", {}, Limits(unpacked=1 << 30, memory=1 << 28)))
    return Stack(objects, "c")


@pytest.mark.parametrize("name", [pytest.param("default", marks=pytest.mark.slow), "quick", "sketch"])
@pytest.mark.parametrize("size", [(384, 288), pytest.param((640, 480), marks=pytest.mark.slow)], ids=str)
def test_ingest_finds_every_pattern_of_a_film(name: str, size: tuple[int, int], tmp_path: Path) -> None:
    program = fit_to_screen(name, size, bordered=True)
    write_video(program, tmp_path / "film.mp4", RATE, lambda done, of: None)
    stack = prepare_film(tmp_path)
    assert stack.attributes["video"]["missing"] == {}
    assert stack.attributes["patterns"] == list(range(program.count))
    at, ticks, _ = stack.shares().T
    shown = np.floor((ticks * stack.attributes["video"]["tick"] - sum(LEAD_SECONDS)) * RATE + 1e-3)
    np.testing.assert_array_equal(shown, at)


def film_of_another_program(name: str, folder: Path) -> None:
    write_video(
        fit_to_screen(name, (384, 288), bordered=True), folder / "film.mp4", RATE, lambda done, of: None
    )
    record = json.loads((folder / "film.json").read_text())
    for part in record["program"]["parts"]:
        if "seed" in part:
            part["seed"] += 100
    (folder / "film.json").write_text(json.dumps(record))


def test_ingest_refuses_the_film_of_another_program(tmp_path: Path) -> None:
    film_of_another_program("default", tmp_path)
    with pytest.raises(CaptureError, match="does not look like"):
        prepare_film(tmp_path)


def test_numbers_in_the_border_count_for_more_than_a_few_random_patterns(tmp_path: Path) -> None:
    film_of_another_program("quick", tmp_path)
    video = prepare_film(tmp_path).attributes["video"]
    assert video["numbered"]
    assert video["resemblance"] < MIN_RESEMBLANCE
