"""Frames that do not show the patterns that they are said to: in another order, doubled, with a hand or a flash."""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from storage.layout import mattes
from storage.layout.captures import Stack, _thumbnail
from storage.objects.store import Objects
from tests.parts.captures import stills_archive
from workflows.composite import composite
from workflows.ingest.report.findings import Finding
from workflows.ingest.report.report import Report, report
from workflows.ingest.trial.frame_order import check_frames
from workflows.jobs import Task, run_all
from workflows.mattes.steps import STEPS
from workflows.programs.files import fit_to_screen
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.programs.video import write_video
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene
from workflows.untrusted.limits import Limits

Codes = NDArray[np.uint8]
HEIGHT, WIDTH = 60, 80
PROGRAM = preset("default", 320, 240)
COUNT = PROGRAM.count
MIDDLE = COUNT // 2


class Frames:
    """What `check_frames` needs of a stack."""

    height, width = HEIGHT, WIDTH

    def __init__(self, frames: Sequence[Codes], mask: NDArray[np.bool_]) -> None:
        self._thumbnails = np.stack([_thumbnail(frame) for frame in frames])
        self._mask = mask
        self.attributes: dict[str, Any] = {
            "program": PROGRAM.model_dump(mode="json"),
            "patterns": list(range(len(frames))),
            "exposures": [1.0] * len(frames),
            "response": "linear",
        }

    def mask(self) -> NDArray[np.bool_]:
        return self._mask

    def thumbnails(self) -> NDArray[np.uint16]:
        return self._thumbnails

    def images(self) -> list[NDArray[np.float32]]:
        return []

    def annotate(self, **attributes: Any) -> None:
        self.attributes |= attributes


@pytest.fixture(scope="module")
def scene() -> Scene:
    return glass_ball(WIDTH, HEIGHT, monitor=(320, 240), rays=9)


@pytest.fixture(scope="module")
def stills(scene: Scene) -> list[Codes]:
    """One of each pattern."""
    return [cast(Codes, frame) for frame in scene.film(PROGRAM)]


def found(stills: Sequence[Codes], scene: Scene) -> dict[str, Any]:
    frames = Frames(stills, scene.object_mask)
    check_frames(cast(Stack, frames), None)
    return {name: frames.attributes[name] for name in ("odd_frames", "order", "constants_apart")}


def covered(still: Codes) -> Codes:
    """A still with a hand before the object."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    hand = np.hypot(y - HEIGHT / 2, x - WIDTH / 2) < HEIGHT / 2
    return np.where(hand[..., np.newaxis], np.uint8(36), still)


def flashed(still: Codes) -> Codes:
    return np.minimum(still.astype(int) + 100, 255).astype(np.uint8)


def replaced(stills: Sequence[Codes], others: dict[int, Codes]) -> list[Codes]:
    return [others.get(n, still) for n, still in enumerate(stills)]


def test_stills_in_order_have_nothing_to_report(stills: list[Codes], scene: Scene) -> None:
    assert found(stills, scene) == {"odd_frames": [], "order": None, "constants_apart": None}
    # the exposure may follow the picture, and the light of the room may change
    dim = [
        (still * factor).astype(np.uint8)
        for still, factor in zip(stills, np.linspace(0.9, 1, COUNT), strict=True)
    ]
    assert found(dim, scene)["odd_frames"] == []
    assert found(dim, scene)["order"] is None


def test_noise_in_the_dark_is_no_other_light(stills: list[Codes], scene: Scene) -> None:
    rng = np.random.default_rng(0)
    dark = [
        np.clip(0.03 * still + rng.normal(1, 1, still.shape), 0, 255).astype(np.uint8) for still in stills
    ]
    assert found(dark, scene)["constants_apart"] is None


@pytest.mark.parametrize("name", ["quick", "default"])
@pytest.mark.parametrize("blur", [8, 24])
def test_frosted_glass_is_in_order(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, name: str, blur: float
) -> None:
    program = preset(name, 320, 240)
    monkeypatch.setattr(sys.modules[__name__], "PROGRAM", program)
    frosted = [gaussian_filter(still, (blur, blur, 0)) for still in scene.film(program)]
    assert found(frosted, scene)["order"] is None


@pytest.mark.parametrize(
    ("mistaken", "kind", "first", "by"),
    [
        (lambda s: s[::-1], "reversed", 0, 0),
        (lambda s: s[61:] + s[:61], "rolled", 0, 61),
        (lambda s: s[:35] + s[36:] + s[-1:], "shifted", 35, 1),
        (lambda s: s[:100] + s[101:] + s[-1:], "shifted", 100, 1),
        (lambda s: s[:71] + s[70:-1], "shifted", 71, -1),
        (lambda s: [s[n] for n in sorted(range(COUNT), key=str)], "unlike", 0, 0),
    ],
    ids=["reversed", "rolled over", "missing", "missing late", "taken twice", "sorted as text"],
)
def test_wrong_order_is_named(
    stills: list[Codes],
    scene: Scene,
    mistaken: Callable[[list[Codes]], list[Codes]],
    kind: str,
    first: int,
    by: int,
) -> None:
    order = found(mistaken(stills), scene)["order"]
    assert order is not None
    assert (order["kind"], order["by"]) == (kind, by)
    assert abs(order["first"] - first) <= 1


@pytest.mark.parametrize(
    ("change", "odd"),
    [
        (lambda s: {MIDDLE: s[MIDDLE - 1]}, [MIDDLE]),
        (lambda s: {MIDDLE: s[MIDDLE + 1], MIDDLE + 1: s[MIDDLE]}, [MIDDLE, MIDDLE + 1]),
        (lambda s: {MIDDLE: covered(s[MIDDLE])}, [MIDDLE]),
        (lambda s: {MIDDLE: flashed(s[MIDDLE])}, [MIDDLE]),
    ],
    ids=["doubled", "swapped", "hand", "flash"],
)
def test_single_frames_of_something_else_are_odd(
    stills: list[Codes], scene: Scene, change: Callable[[list[Codes]], dict[int, Codes]], odd: list[int]
) -> None:
    changed = replaced(stills, change(stills))
    assert found(changed, scene) == {"odd_frames": odd, "order": None, "constants_apart": None}


def test_longer_exposures_of_an_odd_frame_are_odd(stills: list[Codes], scene: Scene) -> None:
    swapped = replaced(stills, {MIDDLE: stills[MIDDLE + 1], MIDDLE + 1: stills[MIDDLE]})
    exposures = (1.0, 2.0)
    frames = Frames(
        [still // 2 * int(factor) for still in swapped for factor in exposures], scene.object_mask
    )
    frames.attributes |= {
        "patterns": np.repeat(np.arange(COUNT), 2).tolist(),
        "exposures": list(exposures) * COUNT,
    }
    check_frames(cast(Stack, frames), None)
    assert frames.attributes["odd_frames"] == list(range(2 * MIDDLE, 2 * MIDDLE + 4))


def test_light_that_is_switched_on_makes_black_frames_differ(stills: list[Codes], scene: Scene) -> None:
    lit = [still if n < MIDDLE else flashed(still) for n, still in enumerate(stills)]
    apart = found(lit, scene)["constants_apart"]
    assert apart["share"] > 0.5
    numbers, sent = PROGRAM.constants
    assert len({tuple(sent[numbers == n][0].tolist()) for n in apart["frames"]}) == 1


def test_border_of_a_film_is_no_light_that_changes(
    ingest: Callable[..., Stack], make_zip: Callable[..., bytes], tmp_path: Path
) -> None:
    film = tmp_path / "film.mp4"
    write_video(fit_to_screen("sketch", (320, 240), bordered=True), film, 2.0, lambda done, of: None)
    manifest = json.loads(film.with_suffix(".json").read_text())
    stack = ingest("c", make_zip(manifest, {film.name: film.read_bytes()}))
    assert stack.attributes["border"]
    assert stack.attributes["constants_apart"] is None


def archive(stills: Sequence[Codes], scene: Scene, program: Program = PROGRAM) -> bytes:
    return stills_archive(program, stills, scene.object_mask)


def judged(ingest: Callable[..., Stack], data: bytes) -> tuple[Report, dict[str, Finding]]:
    stack = ingest("c", data)
    made = report(stack.attributes, stack.frames)
    return made, {finding.name: finding for finding in made.findings}


def test_an_odd_frame_is_reported(ingest: Callable[..., Stack], stills: list[Codes], scene: Scene) -> None:
    _, findings = judged(ingest, archive(replaced(stills, {MIDDLE: covered(stills[MIDDLE])}), scene))
    assert findings["odd_frames"].message.endswith(f": recovery does without {MIDDLE} ({MIDDLE}.png)")
    assert findings["odd_frames"].level == "warning"


def test_wrong_order_promises_nothing(
    ingest: Callable[..., Stack], stills: list[Codes], scene: Scene
) -> None:
    made, findings = judged(ingest, archive(stills[:35] + stills[36:] + stills[-1:], scene))
    assert made.quality is None
    assert list(findings) == ["order", "frames"]
    assert "a still is missing" in findings["order"].message


def test_covered_lens_promises_nothing(
    ingest: Callable[..., Stack], stills: list[Codes], scene: Scene
) -> None:
    rng = np.random.default_rng(0)
    made, _ = judged(ingest, archive([rng.integers(0, 3, s.shape, np.uint8) for s in stills], scene))
    assert made.quality is None
    assert made.level == "bad"
    assert "monitor" in made.findings[0].remedy


@pytest.mark.slow
def test_recovery_does_without_odd_frames(
    ingest: Callable[..., Stack], objects: Objects, stills: list[Codes], scene: Scene
) -> None:
    def decibels(frames: Sequence[Codes]) -> float:
        ingest("c", archive(frames, scene))
        task = Task("j", "c", "m", {}, Limits(1 << 30, 1 << 26))
        run_all(STEPS, objects, task)
        backdrop = np.random.default_rng(1).random((12, 16, 3), np.float32)
        truth = 0.02 + 0.9 * scene.composite(backdrop)
        error = (composite(mattes.Matte(objects, "m"), backdrop)[..., :3] - truth)[scene.object_mask]
        return float(-10 * np.log10((error**2).mean()))

    good = decibels(stills)
    hand = replaced(stills, {MIDDLE: covered(stills[MIDDLE])})
    swapped = replaced(stills, {60: stills[61], 61: stills[60]})
    assert min(decibels(hand), decibels(swapped)) > good - 1.5
