"""What a survey measures of captures whose exposure and clipping are known."""

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout.captures import Stack
from tests.parts.captures import captured, nested_program
from workflows.images.integer_formats import decode, encode_png
from workflows.images.tone_curves import to_light
from workflows.ingest.report.findings import Finding
from workflows.ingest.report.report import Report, report
from workflows.ingest.report.survey import survey
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

Ingest = Callable[..., Stack]


@pytest.fixture(scope="module")
def capture_archive() -> bytes:
    target = io.BytesIO()
    scene = glass_ball(120, 90, monitor=(320, 240), rays=16)
    write_capture(scene, preset("default", 320, 240), target, mask=True)
    return target.getvalue()


def filmed(
    capture_archive: bytes,
    *,
    gain: float = 1,
    less: int = 0,
    curve: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    **more: Any,
) -> bytes:
    """The capture as another exposure, or a camera that takes something off, would have had it."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(capture_archive)) as archive, zipfile.ZipFile(target, "w") as out:
        manifest = json.loads(archive.read("capture.json"))
        out.writestr("capture.json", json.dumps(manifest | more))
        out.writestr(manifest["mask"], archive.read(manifest["mask"]))
        for frame in manifest["frames"]:
            values = decode(archive.read(frame["file"]), memory=1 << 24).astype(np.float64) * gain - less
            if curve is not None:
                values = 255 * curve(values / 255)
            out.writestr(frame["file"], encode_png(np.clip(np.rint(values), 0, 255).astype(np.uint8)))
    return target.getvalue()


def reported(ingest: Ingest, data: bytes) -> tuple[Report, dict[str, Finding]]:
    stack = ingest("c", data)
    made = report(stack.attributes, stack.frames)
    return made, {finding.name: finding for finding in made.findings}


def test_good_capture_has_no_warnings(ingest: Ingest, capture_archive: bytes) -> None:
    made, found = reported(ingest, capture_archive)
    assert made.level == "good"
    assert {finding.level for finding in made.findings} == {"good"}
    assert all(finding.message and not finding.remedy for finding in made.findings)
    assert made.frames.model_dump() == {"kept": 140, "patterns": 140, "exposures": 1, "missing": []}
    assert made.clipping.white == 0
    assert made.white_reaches == pytest.approx(0.86, abs=0.03)
    assert made.noise.black == pytest.approx(255 * 0.0025, rel=0.4)
    assert "no difference to black and white" in found["monitor_curve"].message


@pytest.mark.slow
def test_a_dark_room_around_the_monitor_changes_little(ingest: Ingest) -> None:
    """Black pixels in which nothing changes are without noise, and never lit."""
    scene, program = glass_ball(80, 60, monitor=(320, 240), rays=4), preset("quick", 320, 240)
    pictures = list(program.pictures(0, program.count))
    random = np.random.default_rng(3)
    seen = [0.03 + 0.8 * scene.composite(picture) for picture in pictures]
    seen = [light + 0.004 * random.standard_normal(light.shape) for light in seen]

    def within(room: int) -> tuple[Report, dict[str, float]]:
        stack = ingest(
            "c", captured(program, lambda n, _: np.pad(seen[n], ((room, room), (room, room), (0, 0))))
        )
        made = report(stack.attributes, stack.frames)
        assert made.quality is not None
        return made, {"noise": made.noise.full, "low": made.quality.low}

    alone, dark = within(0), within(60)
    assert dark[1] == pytest.approx(alone[1], rel=0.05)
    assert dark[0].clipping.black < 0.02
    assert dark[0].level == alone[0].level


@pytest.mark.slow
def test_a_white_that_is_clipped_asks_for_less_exposure(ingest: Ingest, capture_archive: bytes) -> None:
    made, found = reported(ingest, filmed(capture_archive, gain=1.3))
    assert made.level == found["exposure"].level == "bad"
    assert made.clipping.white > 0.3
    assert "expose a stop less" in found["exposure"].remedy


def test_nothing_is_promised_where_nearly_all_is_clipped(ingest: Ingest, capture_archive: bytes) -> None:
    made, found = reported(ingest, filmed(capture_archive, gain=20))
    assert made.clipping.white > 0.95
    assert made.quality is None
    assert "quality" not in found
    assert "what to expect of composites" in found["unmeasured"].message
    assert "brighter" not in found["unmeasured"].remedy


@pytest.mark.parametrize(
    ("gain", "level", "more"),
    [(0.4, "warning", "a stop more"), (0.1, "bad", "3 stops more")],
)
@pytest.mark.slow
def test_a_dark_white_asks_for_more_exposure(
    ingest: Ingest, capture_archive: bytes, gain: float, level: str, more: str
) -> None:
    _, found = reported(ingest, filmed(capture_archive, gain=gain))
    assert found["exposure"].level == level
    assert more in found["exposure"].remedy


@pytest.mark.slow
def test_a_clipped_black_is_found(ingest: Ingest, capture_archive: bytes) -> None:
    made, found = reported(ingest, filmed(capture_archive, less=9))
    assert found["black"].level == "bad"
    assert made.clipping.black > 0.9


@pytest.mark.slow
def test_more_noise_and_fewer_patterns_promise_less(ingest: Ingest, capture_archive: bytes) -> None:
    def promised(data: bytes) -> tuple[float, float]:
        quality = reported(ingest, data)[0].quality
        assert quality is not None
        return quality.low, quality.high

    scene = glass_ball(60, 45, monitor=(320, 240), rays=4)
    noisy, few = io.BytesIO(), io.BytesIO()
    write_capture(scene, preset("default", 320, 240), noisy, noise=6)
    write_capture(scene, preset("sketch", 320, 240), few)
    best = promised(capture_archive)
    for data in (noisy.getvalue(), few.getvalue()):
        assert all(lesser < b - 2 for lesser, b in zip(promised(data), best, strict=True))
    assert best[0] < best[1] < 60


@pytest.mark.slow
def test_of_a_white_that_was_exposed_unevenly_the_darkest_frame_counts(ingest: Ingest) -> None:
    scene, program = glass_ball(80, 60, monitor=(320, 240), rays=4), preset("quick", 320, 240)
    white = program.constants[0][(program.constants[1] == 1).all(axis=1)]
    exposure = np.where(np.isin(range(program.count), white[:-1]), 1.5, 1.0)

    def see(n: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        return (0.02 + 0.7 * scene.composite(to_light(picture, "srgb"))) * exposure[n]

    stack = ingest("c", captured(program, see))
    assert report(stack.attributes, stack.frames).clipping.white > 0.5
    stack.annotate(auto_exposure=exposure.tolist())
    survey(stack)
    assert report(stack.attributes, stack.frames).clipping.white == 0


@pytest.mark.slow
def test_a_curve_of_any_shape_is_measured_by_half_tones(ingest: Ingest, capture_archive: bytes) -> None:
    made, found = reported(ingest, filmed(capture_archive, curve=lambda x: x**0.6, response="unknown"))
    assert made.camera.source == "estimated"
    assert found["camera_curve"].level == "good"
    half = to_light(np.array([0.4, 0.8], np.float32) ** np.float32(0.6), made.camera.curve)
    assert half[0] / half[1] == pytest.approx(0.5, abs=0.02)
    assert "quality" in found


@pytest.mark.slow
def test_channels_with_different_curves_are_measured_apart(ingest: Ingest, capture_archive: bytes) -> None:
    powers = np.array([0.66, 0.6, 0.54])
    made, _ = reported(ingest, filmed(capture_archive, curve=lambda x: x**powers, response="unknown"))
    assert isinstance(made.camera.curve, tuple)
    for own, power in zip(made.camera.curve, powers, strict=True):
        half = to_light(np.array([0.4, 0.8], np.float32) ** np.float32(power), own)
        assert half[0] / half[1] == pytest.approx(0.5, abs=0.02)


@pytest.mark.slow
def test_half_tones_disagree_with_a_curve_that_is_stated_wrongly(
    ingest: Ingest, capture_archive: bytes
) -> None:
    _, right = reported(ingest, capture_archive)
    assert "half-tones agree" in right["camera_curve"].message
    made, found = reported(ingest, filmed(capture_archive, curve=lambda x: x**0.7))
    assert made.camera.apart is not None
    assert made.camera.apart > 0.06
    assert found["camera_curve"].level == "warning"


@pytest.mark.slow
def test_a_curve_that_is_assumed_is_a_warning(ingest: Ingest) -> None:
    target = io.BytesIO()
    scene, bands = glass_ball(120, 90, monitor=(320, 240), rays=16), ((16, 12, 24), (32, 24, 24))
    program = nested_program((320, 240), bands=bands, levels=2)
    write_capture(scene, program, target, mask=True)
    made, found = reported(ingest, filmed(target.getvalue(), response="unknown"))
    assert made.camera.source == "assumed"
    assert [f for f in made.findings if f.level == "bad"] == []
    assert made.level == found["camera_curve"].level == "warning"
    assert "state it in capture.json" in found["camera_curve"].remedy


@pytest.mark.slow
def test_capture_without_light_is_bad(ingest: Ingest, capture_archive: bytes) -> None:
    made, found = reported(ingest, filmed(capture_archive, gain=0))
    assert made.level == "bad"
    assert made.drift is made.flicker is made.quality is None
    assert found["noise"].level == "bad"
