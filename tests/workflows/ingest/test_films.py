"""Films are read in a decoder: the same values, in bounded memory, and none that a taken over decoder makes up. Frames
are added up while the patterns are found: most are decoded once, and the means are the same.
"""

import io
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from storage.errors import CaptureError, Unavailable
from storage.layout import uploads
from storage.objects.store import Objects
from tests.workflows.composite.video.test_steps import clip, even, pictures
from tests.workflows.ingest.video.camera import Film, fragmented, overstated
from tests.workflows.ingest.video.camera import film as filmed_by
from tests.workflows.ingest.video.films import CAMERA, IngestFilm, error_of
from workflows.images.hdr import HLG, light_of_hdr
from workflows.ingest import films
from workflows.ingest.plateau_sums import PlateauSums, from_bytes, name_of, to_bytes
from workflows.ingest.video.clip import Clip, open_clip
from workflows.ingest.video.frame_means import TOTAL_WEIGHT, FrameSum, Share, mean_frames, mean_of
from workflows.ingest.video.signatures import CELLS, SmallCopies
from workflows.untrusted.decoder import Decoder

IMAGE = 1 << 20
FILM = clip(pictures(9), even(9))
COUNTS_SAMPLES = av.library_versions["libavformat"] >= (63,)
"""Whether FFmpeg knows by itself how many samples can be in a fragment at most."""


@pytest.fixture
def decoder() -> Iterator[Decoder]:
    with Decoder(IMAGE) as decoder:
        yield decoder


def test_values_are_those_of_the_same_functions_here(decoder: Decoder) -> None:
    file = io.BytesIO(FILM)
    film, ticks, last = films.times(decoder, file, "film.mp4", 100)
    with open_clip(io.BytesIO(FILM), "film.mp4", IMAGE) as here:
        expected, expected_last = here.ticks(100)
        np.testing.assert_array_equal(ticks, expected)
        assert (last, film.width, film.height) == (expected_last, here.width, here.height)
        assert (film.time_base, film.stated_duration, film.lost) == (here.time_base, here.stated_duration, [])
    for every in (None, 0.2):
        _, signatures, again, large = films.scan(decoder, file, "film.mp4", IMAGE, every)
        with open_clip(io.BytesIO(FILM), "film.mp4", IMAGE) as here:
            copies = SmallCopies(here, IMAGE, np.inf if every is None else every)
            for frame in here.frames():
                copies.add(frame)
            found = copies.taken()
        for one, other in zip((signatures, again, *large), (*found[:2], *found[2]), strict=True):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
    plan = [[Share(tick, TOTAL_WEIGHT)] for tick in ticks.tolist()]
    means = films.means(decoder, file, "film.mp4", plan, film.width, film.height)
    with open_clip(io.BytesIO(FILM), "film.mp4", IMAGE) as here:
        for mean, expected_mean in zip(means, mean_frames(here, plan), strict=True):
            np.testing.assert_array_equal(mean, expected_mean)


def test_means_of_another_size_end_the_decoder(decoder: Decoder) -> None:
    _, ticks, _ = films.times(decoder, io.BytesIO(FILM), "film.mp4", 100)
    plan = [[Share(int(ticks[0]), TOTAL_WEIGHT)]]
    with pytest.raises(Unavailable, match=r"film\.mp4 ended"):
        list(films.means(decoder, io.BytesIO(FILM), "film.mp4", plan, 7, 7))
    assert decoder.has_ended


@pytest.mark.parametrize("white", [0.5, 3.0])
def test_monitor_brighter_than_the_white_of_hdr_is_not_clipped(
    ingest_film: IngestFilm, light: list[NDArray[np.float32]], white: float
) -> None:
    filmed = filmed_by(light, replace(CAMERA, codec="libx265", hlg=white))
    stack = ingest_film(filmed.data)
    full = stack.attributes["storage"]["full"]
    assert full == pytest.approx(max(1.1 * white * np.max(light), 1), rel=0.1)
    assert (stack.read() == 65535).mean() < 0.001
    scaled = replace(filmed, light=[white / full * one for one in light])
    assert error_of(stack, scaled) < 6


def test_only_what_the_monitor_lights_sets_full_scale() -> None:
    film = films.Film(
        width=2,
        height=1,
        numerator=1,
        denominator=30,
        stated_duration=1,
        interlaced=False,
        transfer=HLG,
        lost=[],
    )
    shown = np.zeros((2, 1, 2, 3), np.uint8)
    shown[:, 0, 0], shown[1, 0, 1] = 255, round(0.9 * 255)  # a lamp, and the monitor
    assert films.full_scale(film, shown) == pytest.approx(
        1.1 * light_of_hdr(HLG)[round(0.9 * 65535)], rel=0.02
    )
    assert films.full_scale(film.model_copy(update={"transfer": 1}), shown) == 1


SIGNATURES, TICKS, GREY, FRAMES = range(1, 5)


@pytest.mark.parametrize(
    ("which", "change"),
    [
        (SIGNATURES, lambda values: values[1:]),
        (SIGNATURES, lambda values: values.astype(np.float32)),
        (SIGNATURES, lambda values: values[..., 0]),
        (SIGNATURES, lambda values: values[..., :2]),
        (SIGNATURES, lambda values: values.repeat(CELLS[0] + 1, axis=2)),
        (SIGNATURES, lambda values: values.repeat(CELLS[1] + 1, axis=1)),
        (TICKS, lambda values: values[::-1].copy()),
        (TICKS, lambda values: np.zeros_like(values)),
        (GREY, lambda values: values[1:]),
        (FRAMES, lambda values: values - 1),
        (FRAMES, lambda values: values + 9),
        (FRAMES, lambda values: values.astype(np.float32)),
    ],
)
def test_what_no_film_gives_ends_the_decoder(
    decoder: Decoder,
    monkeypatch: pytest.MonkeyPatch,
    which: int,
    change: Callable[[NDArray[Any]], NDArray[Any]],
) -> None:
    file = io.BytesIO(FILM)
    given = {"entry": "film.mp4", "memory": IMAGE, "max_bytes": IMAGE, "every": 0.2, "hold": None}
    answers: list[Any] = list(decoder.run(films._scan, file, **given))
    answers[which] = change(answers[which])
    monkeypatch.setattr(decoder, "run", lambda *_, **__: iter(answers))
    with pytest.raises(Unavailable, match=r"film\.mp4 ended"):
        films.scan(decoder, file, "film.mp4", IMAGE, 0.2)
    assert decoder.has_ended


SUM = [{"shares": [[0, 257]]}, np.zeros(9, np.uint8)]


@pytest.mark.parametrize(
    "sums",
    [
        [SUM[0]],
        [SUM[0], np.zeros((3, 3), np.uint8)],
        [{"shares": [[0, "much"]]}, SUM[1]],
        [{"shares": 257}, SUM[1]],
        2 * SUM,
    ],
)
def test_sums_that_are_none_or_too_many_end_the_decoder(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch, sums: list[Any]
) -> None:
    kept: dict[str, memoryview] = {}
    keep = films.KeepSums(0.5, 1, kept.__setitem__)
    answers: list[Any] = [*films._scan(io.BytesIO(FILM), "film.mp4", IMAGE, IMAGE, 0.2, None)]
    monkeypatch.setattr(decoder, "run", lambda *_, **__: iter([*SUM, *answers]))
    films.scan(decoder, io.BytesIO(FILM), "film.mp4", IMAGE, 0.2, keep)
    assert [*kept.values()] == [bytes(9)]
    monkeypatch.setattr(decoder, "run", lambda *_, **__: iter([*sums, *answers]))
    with pytest.raises(Unavailable, match=r"film\.mp4 ended"):
        films.scan(decoder, io.BytesIO(FILM), "film.mp4", IMAGE, 0.2, keep)
    assert decoder.has_ended


@pytest.mark.skipif(sys.platform != "linux", reason="it is Linux that limits what a process takes")
@pytest.mark.parametrize(
    ("film", "reason"),
    [
        (overstated(FILM, 40_000_000), "an index that takes too much memory"),
        (fragmented(4_000_000), "cut off or damaged" if COUNTS_SAMPLES else "takes more than the 264 MB"),
    ],
    ids=["at once", "bit by bit"],
)
def test_film_of_a_few_kilobytes_does_not_take_gigabytes(decoder: Decoder, film: bytes, reason: str) -> None:
    assert len(film) < 20_000
    with pytest.raises(CaptureError, match=reason) as caught:
        films.times(decoder, io.BytesIO(film), "film.mp4", 1000)
    assert caught.value.fields["entry"] == "film.mp4"


MEMORY = 1 << 24


def sums_of(data: bytes, memory: int = MEMORY) -> list[tuple[list[Share], FrameSum]]:
    """The plateaus of a film and their sums."""
    with closing(Clip(io.BytesIO(data), "film", MEMORY)) as clip:
        copies, sums = SmallCopies(clip, MEMORY), PlateauSums(clip, CAMERA.hold, memory)
        return [one for frame in clip.frames() for one in sums.add(frame, copies.add(frame))]


@pytest.mark.parametrize("changes", [{}, {"hlg": 1.0, "codec": "libx265"}, {"uneven": 0.6}])
def test_means_of_sums_are_those_of_frames_decoded_again(
    light: list[NDArray[np.float32]], changes: dict[str, Any]
) -> None:
    data = filmed_by(light, replace(CAMERA, **changes)).data
    found = sums_of(data)
    assert len(found) > 0.9 * len(light)
    with closing(Clip(io.BytesIO(data), "film", MEMORY)) as clip:
        for (_, total), mean in zip(found, mean_frames(clip, [shares for shares, _ in found]), strict=True):
            packed = to_bytes(total)
            np.testing.assert_array_equal(mean_of(from_bytes(io.BytesIO(packed.tobytes())), 1.0), mean)


def test_waiting_frames_take_no_more_memory_than_allowed(filmed: Film) -> None:
    with closing(Clip(io.BytesIO(filmed.data), "film", MEMORY)) as clip:
        frame = next(clip.frames())
        size = sum(plane.buffer_size for plane in frame.planes)
    # A pattern is shown for nine frames, and some more must pass before it is known to have ended.
    assert not sums_of(filmed.data, 8 * size)
    assert sums_of(filmed.data, 30 * size)


def test_most_patterns_are_not_decoded_again_and_all_are_the_same_bytes(
    ingest_film: IngestFilm,
    filmed: Film,
    objects: Objects,
    digests: Callable[[str], dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ran: list[str] = []
    run = Decoder.run

    def spied(self: Decoder, function: Callable[..., Any], *given: Any, **more: Any) -> Iterator[Any]:
        ran.append(function.__name__)
        return run(self, function, *given, **more)

    def some_lost(tiles: range) -> Iterator[int]:
        for name in sorted(uploads.sums(objects, "c"))[::2]:
            objects.delete(f"{uploads.path('c')}/{uploads.SUMS}/{name}")
        return iter(tiles)

    def all_lost(tiles: range) -> Iterator[int]:
        objects.delete(f"{uploads.path('c')}/{uploads.SUMS}")
        return iter(tiles)

    monkeypatch.setattr(Decoder, "run", spied)
    stack = ingest_film(filmed.data)
    assert ran.count("_mean_of_sum") > 0.9 * stack.frames
    once = digests("captures/c")
    for lost in (some_lost, all_lost):
        ran.clear()
        ingest_film(filmed.data, order=lost)
        assert digests("captures/c") == once
        assert "_means" in ran
    assert "_mean_of_sum" not in ran


def test_a_name_stands_for_frames_and_weights() -> None:
    plan = [[Share(1, 200), Share(2, 57)], [Share(1, 200), Share(3, 57)], [Share(1, 199), Share(2, 58)]]
    assert len({name_of(shares) for shares in plan}) == 3
    assert name_of([Share(1, 200), Share(2, 57)]) == name_of(plan[0])
