"""Captures of a camera that brightens what is dark around a place: its power is measured, and nothing is else."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from storage.layout.captures import Stack
from tests.parts.captures import captured, nested_program
from workflows.images.tone_curves import to_light
from workflows.ingest.camera.border_exposure import BorderLight
from workflows.ingest.light.local_gain import surroundings
from workflows.ingest.pixel_sample import PixelSample
from workflows.ingest.report.report import report
from workflows.ingest.trial import tone_mapping
from workflows.ingest.trial.border_tone_mapping import Power
from workflows.ingest.trial.tone_mapping import LEAST, find_tone_mapping
from workflows.ingest.trial.unexplained import Rest
from workflows.programs.program import Program
from workflows.recovery.camera.noise import NoiseModel
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene

Ingest = Callable[..., Stack]
WIDTH, HEIGHT, MONITOR = 96, 72, (160, 120)
NOISE = 0.003


@pytest.fixture(scope="module")
def scene() -> Scene:
    return glass_ball(WIDTH, HEIGHT, monitor=MONITOR, rays=4)


@pytest.fixture(scope="module")
def program() -> Program:
    bands = ((8, 6, 14), (16, 12, 12), (32, 24, 12), (80, 60, 12))
    return nested_program(MONITOR, bands=bands, levels=2)


def filmed(scene: Scene, program: Program, power: float = 0.0, sharpening: float = 0.0) -> bytes:
    """A capture of linear light: a gain follows the brightness around a place, then edges are sharpened."""
    rng = np.random.default_rng(5)

    def see(n: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        light = 0.03 + 0.65 * scene.composite(to_light(picture, "srgb").astype(np.float32))
        near = gaussian_filter(light.mean(axis=2) ** (1 / 2.2), WIDTH / 10)
        light = light * ((near + 0.05)[..., np.newaxis] / 0.6) ** -power
        light = light + sharpening * (light - gaussian_filter(light, (1, 1, 0)))
        return light + NOISE * rng.standard_normal(light.shape)

    return captured(program, see)


def left_by(
    power: float,
    pixels: int = 400,
    frames: int = 40,
    *,
    mixed: float = 0.0,
    smeared: float = 0.0,
    sharpened: float = 0.0,
) -> tuple[Stack, Rest, PixelSample]:
    """Residuals of pixels that see patterns as all black or all white, by a camera that maps tones.

    Where it is ``mixed``, patterns in colour are brighter in bright surroundings, and a channel sees so much of the
    others. Where it is ``smeared``, a fifth of the values are neither, which changes those of the other channels. Where
    it is ``sharpened``, bright pixels around each, as are in bright surroundings, take so much of its light away.
    """
    rng = np.random.default_rng(1)
    thumbnails = gaussian_filter(rng.random((frames, 60, 80)), (0, 6, 6))
    thumbnails = np.clip(0.5 + (thumbnails - thumbnails.mean()) * 0.25 / thumbnails.std(), 0, 1)
    attributes = {"response": "srgb", "storage": {"black": 0}, "patterns": list(range(frames))}
    stack = SimpleNamespace(
        attributes=attributes,
        thumbnails=lambda: np.rint(65535 * thumbnails).astype(np.uint16),
        height=240,
        width=320,
        dtype=np.dtype(np.uint16),
    )
    near = surroundings(cast(Stack, stack), 1 / 10)
    assert near is not None
    y, x = rng.integers(0, 240, pixels), rng.integers(0, 320, pixels)
    around = near.at(y, x) - near.values.mean()
    plain = rng.choice([-1.0, 1.0], (pixels, 3, frames))
    if mixed:
        plain = np.sign(around.T[:, np.newaxis] / around.std() + 2 * rng.standard_normal(plain.shape))
    between = rng.random(plain.shape) < (0.2 if smeared else 0)
    plain[between] *= 0.5
    level = 0.03 + 0.3 * (1 + plain)
    flicker = 1 + 0.01 * rng.standard_normal(frames)
    seen = level * (flicker * np.exp(-power * around.T[:, np.newaxis]) - 1)
    seen += mixed * (plain.sum(axis=1, keepdims=True) - plain)
    seen += smeared * around.T[:, np.newaxis] * between.any(axis=1, keepdims=True)
    rings = 0.5 + 0.5 * around + 0.1 * rng.standard_normal((3, frames, pixels))
    seen += sharpened * level * (rings[0] - 2 * rings[1]).T[:, np.newaxis]
    rest = SimpleNamespace(
        flat=(rng.random(plain.shape) < 0.5) & ~between,
        frames=np.arange(frames),
        level=level,
        plain=plain,
        rho=np.full(plain.shape, 0.6),
        rest=(seen + NOISE * rng.standard_normal(plain.shape)) * 2 / 0.6,
        noise=NoiseModel(NOISE**2, 0.0),
    )
    sample = SimpleNamespace(
        places=(y, x), chosen=(np.arange(pixels) // 10,), rings=lambda widest: list(rings[:widest])
    )
    return cast(Stack, stack), cast(Rest, rest), cast(PixelSample, sample)


def test_power_is_that_of_the_residuals() -> None:
    found = find_tone_mapping(*left_by(0.1), None)
    assert found is not None
    assert found["power"] == pytest.approx(0.1, rel=0.05)
    assert found["width"] == 1 / 10
    assert np.exp(found["usual"]) == pytest.approx(0.39 + 0.05, abs=0.005)  # middle grey, and what is added


@pytest.mark.parametrize("power", [0.0, 0.1])
@pytest.mark.parametrize("by_colours", [{"mixed": 0.05}, {"smeared": 0.05}])
def test_effect_of_other_colours_is_separated(power: float, by_colours: dict[str, float]) -> None:
    found = find_tone_mapping(*left_by(power, **by_colours), None)
    assert (found and found["power"]) == (pytest.approx(power, rel=0.1) if power else None)


def test_sharpening_is_none_beside_the_pixels_that_it_takes_light_from() -> None:
    assert find_tone_mapping(*left_by(0.0, sharpened=0.3), None) is None
    assert find_tone_mapping(*left_by(0.1, sharpened=0.05), None) is not None


@pytest.mark.parametrize("power", [-0.1, 0.0, LEAST / 2])
def test_what_is_no_tone_mapping_is_left_out(power: float) -> None:
    assert find_tone_mapping(*left_by(power), None) is None


def test_what_was_corrected_is_added_to() -> None:
    known = {"power": 0.08, "width": 1 / 10, "usual": -0.5, "spread": 0.2}
    found = find_tone_mapping(*left_by(0.02), known)
    assert found is not None
    assert found == known | {"power": pytest.approx(0.1, rel=0.05)}


@pytest.mark.parametrize(("error", "power"), [(0.0001, 0.05), (0.5, 0.1)])
def test_smaller_error_decides_between_sample_and_border(
    monkeypatch: pytest.MonkeyPatch, error: float, power: float
) -> None:
    monkeypatch.setattr(tone_mapping, "border_power", lambda border, near: Power(0.05, error, 30.0))
    found = find_tone_mapping(*left_by(0.1), None, cast(BorderLight, "border"))
    assert found is not None
    assert found["power"] == pytest.approx(power, rel=0.05)


@pytest.mark.parametrize("known", [None, {"power": 0.1, "width": 1 / 10, "usual": -0.5, "spread": 0.2}])
def test_more_than_any_tone_mapping_is_none(
    known: dict[str, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tone_mapping, "border_power", lambda border, near: Power(400.0, 1e-9, 30.0))
    assert find_tone_mapping(*left_by(0.1), known, cast(BorderLight, "border")) is None


def test_border_tells_alone_where_too_few_pixels_do(monkeypatch: pytest.MonkeyPatch) -> None:
    stack, rest, sample = left_by(0.1)
    rest.flat[:] = False
    assert find_tone_mapping(stack, rest, sample, None) is None
    monkeypatch.setattr(tone_mapping, "border_power", lambda border, near: Power(0.05, 0.005, 30.0))
    found = find_tone_mapping(stack, rest, sample, None, cast(BorderLight, "border"))
    assert found is not None
    assert found["power"] == 0.05


@pytest.mark.slow
def test_power_is_measured_and_reported(scene: Scene, program: Program, ingest: Ingest) -> None:
    stack = ingest("c", filmed(scene, program, power=0.1))
    found = stack.attributes["tone_mapping"]
    assert found["power"] == pytest.approx(0.1, rel=0.25)
    assert found["width"] == 1 / 10
    (finding,) = (f for f in report(stack.attributes, stack.frames).findings if f.name == "tone_mapping")
    assert finding.level == "warning"
    assert "recovery corrects it" in finding.message


@pytest.mark.slow
@pytest.mark.parametrize("sharpening", [0.0, 0.5])
def test_neither_a_clean_camera_nor_sharpening_is_taken_for_it(
    scene: Scene, program: Program, ingest: Ingest, sharpening: float
) -> None:
    stack = ingest("c", filmed(scene, program, sharpening=sharpening))
    assert stack.attributes["tone_mapping"] is None
    assert not any(f.name == "tone_mapping" for f in report(stack.attributes, stack.frames).findings)
