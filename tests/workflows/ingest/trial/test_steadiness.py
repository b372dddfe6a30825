"""Captures that drift and flicker by known amounts: what is found, and what composites gain when it is taken out."""

import io
import json
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import zoom

from storage.layout import mattes
from storage.layout.captures import Stack
from storage.objects.store import Objects
from tests.parts.captures import nested_program
from workflows.composite import composite
from workflows.images.integer_formats import encode_png
from workflows.images.resample import area_mean
from workflows.images.tone_curves import to_light
from workflows.ingest.report.findings import Finding
from workflows.ingest.report.report import report
from workflows.jobs import Task, run_all
from workflows.mattes.steps import STEPS
from workflows.mattes.tiles import patterns_of
from workflows.programs.presets import preset
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene, write_capture
from workflows.untrusted.limits import Limits

Floats = NDArray[np.float32]
Ingest = Callable[..., Stack]
Digests = Callable[[str], dict[str, str]]
WIDTH, HEIGHT, FINER = 72, 54, 4
BLUR = 0.5


def blurred(fine: Floats, shift: tuple[float, float]) -> Floats:
    """A fine picture as the camera's pixels see it through a lens that is a little soft, moved by a shift."""
    wave = [np.fft.fftfreq(size) for size in fine.shape[:2]]
    soft = [np.exp(-2 * (np.pi * BLUR * FINER * k) ** 2) for k in wave]
    turn = [np.exp(-2j * np.pi * k * FINER * s) for k, s in zip(wave, reversed(shift), strict=True)]
    passed = (soft[0] * turn[0])[:, np.newaxis, np.newaxis] * (soft[1] * turn[1])[np.newaxis, :, np.newaxis]
    moved = np.fft.ifft2(np.fft.fft2(fine, axes=(0, 1)) * passed, axes=(0, 1)).real
    return area_mean(moved.astype(np.float32), WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def ball(request: pytest.FixtureRequest) -> tuple[Scene, Program, list[Floats], NDArray[np.bool_]]:
    """A ball, traced finer than it is filmed, the program's light at the fine pixels, and the camera's mask."""
    scene = glass_ball(WIDTH * FINER, HEIGHT * FINER, monitor=(320, 240), rays=4)
    program = preset(request.param, 320, 240)
    light = [scene.composite(to_light(picture, "srgb")) for picture in program.pictures(0, program.count)]
    mask = scene.object_mask.reshape(HEIGHT, FINER, WIDTH, FINER).all(axis=(1, 3))
    return scene, program, light, mask


Ball = tuple[Scene, Program, list[Floats], NDArray[np.bool_]]


def filmed(ball: Ball, shifts: NDArray[np.float64], gains: NDArray[np.float64]) -> bytes:
    """The capture with frames that are moved, and lit, by what is given."""
    _, program, light, mask = ball
    rng = np.random.default_rng(4)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        manifest = {
            "format": "envmatte-capture/1",
            "program": program.model_dump(mode="json"),
            "frames": [{"file": f"{n}.png", "pattern": n} for n in range(program.count)],
            "response": "linear",
            "mask": "mask.png",
        }
        archive.writestr("capture.json", json.dumps(manifest))
        archive.writestr("mask.png", encode_png(mask[..., np.newaxis].astype(np.uint8) * 255))
        for n, picture in enumerate(light):
            value = 0.02 + 0.72 * gains[n] * blurred(picture, tuple(shifts[n]))
            value += (0.002 + 0.006 * np.sqrt(np.maximum(value, 0))) * rng.standard_normal(value.shape)
            archive.writestr(f"{n}.png", encode_png(np.rint(np.clip(value, 0, 1) * 255).astype(np.uint8)))
    return target.getvalue()


def decibels(objects: Objects, ball: Ball, shift: tuple[float, float]) -> float:
    """PSNR of a composite over the ball, where it lies by a shift."""
    scene, _, _, mask = ball
    task = Task("j", "c", "m", {}, Limits(1 << 30, 1 << 26))
    run_all(STEPS, objects, task)
    y, x = np.mgrid[:240, :320]
    checker = ((y // 24 + x // 24) % 2).astype(np.float32)
    backdrop = np.stack([checker, x.astype(np.float32) / 320, 1 - checker], axis=2)
    truth = 0.02 + 0.72 * blurred(scene.composite(backdrop), shift)
    error = ((composite(mattes.Matte(objects, "m"), backdrop)[..., :3] - truth)[mask] ** 2).mean(axis=1)
    # a few pixels at the rim, where all of the monitor is in one, are another matter
    return float(-10 * np.log10(np.sort(error)[: int(0.99 * error.size)].mean()))


def compared(
    ingest: Ingest, objects: Objects, ball: Ball, shifts: NDArray[np.float64], gains: NDArray[np.float64]
) -> tuple[Stack, dict[str, Finding], float, float]:
    """The stack and its findings, and the PSNR with what was found taken out, and without."""
    stack = ingest("c", filmed(ball, shifts, gains))
    found = {finding.name: finding for finding in report(stack.attributes, stack.frames).findings}
    middle = shifts[ball[1].measured].mean(axis=0)
    with_it = decibels(objects, ball, tuple(middle))
    stack.annotate(shifts=None, gains=None)
    stack.save()
    return stack, found, with_it, decibels(objects, ball, tuple(middle))


def steady(ball: Ball) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.zeros((ball[1].count, 2)), np.ones(ball[1].count)


@pytest.mark.slow
@pytest.mark.parametrize("ball", ["default", "quick"], indirect=True)
def test_steady_frames_are_unchanged(ingest: Ingest, ball: Ball) -> None:
    stack = ingest("c", filmed(ball, *steady(ball)))
    made = report(stack.attributes, stack.frames)
    assert made.drift is not None
    assert made.flicker is not None
    assert made.drift.pixels < 0.05
    assert made.flicker.percent < 0.2
    assert not made.drift.corrected
    assert not made.flicker.corrected
    assert {f.name: f.level for f in made.findings if f.name in ("drift", "flicker")} == {
        "drift": "good",
        "flicker": "good",
    }
    assert stack.attributes["shifts"] is stack.attributes["gains"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ball", "pixels", "jumps", "gain"),
    [
        pytest.param("default", 0.3, False, 6, marks=pytest.mark.exhaustive),
        ("default", 0.6, True, 6),
        pytest.param("quick", 1.0, False, 8, marks=pytest.mark.exhaustive),
    ],
    indirect=["ball"],
)
def test_drift_is_found_and_taken_out(
    ingest: Ingest, objects: Objects, ball: Ball, pixels: float, jumps: bool, gain: float
) -> None:
    shifts, gains = steady(ball)
    time = np.arange(len(shifts)) / len(shifts)
    shifts[:] = np.outer(np.round(time) if jumps else time, [0.8 * pixels, -0.6 * pixels])
    stack, found, with_it, without = compared(ingest, objects, ball, shifts, gains)
    drift = stack.attributes["steadiness"]["drift"]
    assert drift["corrected"]
    assert drift["pixels"] == pytest.approx(pixels, rel=0.25)
    first, last = drift["quarters"][0], drift["quarters"][-1]
    assert last[0] - first[0] > 0.45 * pixels
    assert last[1] - first[1] < -0.35 * pixels
    assert "shifts the frames back" in found["drift"].message
    assert found["drift"].level == ("good" if pixels < 0.45 else "warning")
    assert with_it > without + gain


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ball", "percent", "gain"),
    [pytest.param("default", 3.0, 2.5, marks=pytest.mark.exhaustive), ("quick", 8.0, 6)],
    indirect=["ball"],
)
def test_flicker_is_found_and_taken_out(
    ingest: Ingest, objects: Objects, ball: Ball, percent: float, gain: float
) -> None:
    shifts, gains = steady(ball)
    gains *= 1 + percent / 100 * np.clip(np.random.default_rng(1).standard_normal(len(gains)), -2, 2)
    gains /= np.median(gains[ball[1].measured])
    stack, found, with_it, without = compared(ingest, objects, ball, shifts, gains)
    flicker = stack.attributes["steadiness"]["flicker"]
    assert flicker["corrected"]
    assert flicker["percent"] == pytest.approx(100 * gains[ball[1].measured].std(), rel=0.1)
    assert "recovery corrects it" in found["flicker"].message
    assert found["flicker"].level == "warning"
    assert not stack.attributes["steadiness"]["drift"]["corrected"]
    assert with_it > without + gain


@pytest.mark.slow
@pytest.mark.parametrize(
    "ball", [pytest.param("default", marks=pytest.mark.exhaustive), "quick"], indirect=True
)
def test_white_that_the_monitor_dims_is_found_and_evened_out(
    ingest: Ingest, objects: Objects, ball: Ball
) -> None:
    shifts, gains = steady(ball)
    numbers, sent = ball[1].constants
    gains[numbers[(sent == 1).all(axis=1)]] = 0.75
    stack, found, with_it, without = compared(ingest, objects, ball, shifts, gains)
    flicker = stack.attributes["steadiness"]["flicker"]
    assert flicker["corrected"]
    assert flicker["white_percent"] == pytest.approx(-25, abs=1)
    assert "camera_curve" not in found  # half-tones, which are not dimmed, do not tell
    assert "limits its brightness" in found["white"].message
    assert with_it > without + 15


@pytest.mark.slow
@pytest.mark.parametrize("ball", ["quick"], indirect=True)
def test_scaled_patterns_do_not_flicker_and_are_recovered_as_the_monitor_interpolates_them(
    ingest: Ingest, objects: Objects, ball: Ball
) -> None:
    scene, program, _, mask = ball
    enlarged = (
        zoom(picture, (1.25, 1.25, 1), order=1, mode="nearest", grid_mode=True)
        for picture in program.pictures(0, program.count)
    )
    light = [scene.composite(to_light(picture, "srgb")) for picture in enlarged]
    stack = ingest("c", filmed((scene, program, light, mask), *steady(ball)))
    assert stack.attributes["scaled"]
    assert stack.attributes["gains"] is None
    as_shown = decibels(objects, ball, (0, 0))
    stack.annotate(scaled=False)
    stack.save()
    patterns_of.cache_clear()
    as_made = decibels(objects, ball, (0, 0))
    assert as_shown > as_made + 4


@pytest.mark.slow
@pytest.mark.parametrize("ball", ["quick"], indirect=True)
def test_light_that_follows_the_patterns_is_named_tone_mapping(ingest: Ingest, ball: Ball) -> None:
    shifts, gains = steady(ball)
    light = np.array([ball[2][n].mean() for n in ball[1].measured])
    gains[ball[1].measured] = np.median(light) / light
    stack = ingest("c", filmed(ball, shifts, gains))
    found = {finding.name: finding for finding in report(stack.attributes, stack.frames).findings}
    assert "flicker" not in found
    assert found["tone_mapping"].level == "warning"
    assert "brightens dark pictures" in found["tone_mapping"].message


def test_too_small_a_frame_tells_nothing(ingest: Ingest) -> None:
    target = io.BytesIO()
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    write_capture(glass_ball(36, 28, monitor=(64, 48), rays=4), program, target, noise=0.5)
    stack = ingest("c", target.getvalue())
    assert stack.attributes["steadiness"] is None
    assert stack.attributes["shifts"] is stack.attributes["gains"] is None
