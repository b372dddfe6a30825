"""The camera's curve from half-tones."""

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from workflows.images.tone_curves import Curve, Gamma, Sampled, from_light, to_light
from workflows.ingest.camera.curve import HalfTones, Shown, are_scaled, fit_camera_curve
from workflows.programs.parts import Halftone, Monitor

SHARES = (0.25, 0.5, 0.75)
Floats = NDArray[np.float32]


def seen(
    tone: Curve | str,
    noise: float = 0.0,
    exposures: tuple[float, ...] = (1.0,) * 5,
    shares: tuple[float, ...] = SHARES,
) -> Floats:
    """Codes of 8 bits of black, white and half-tones, (5, n), by pixels that see more or less of the monitor."""
    random = np.random.default_rng(3)
    S, rho = random.uniform(0.005, 0.03, 20_000), random.uniform(0.05, 0.85, 20_000)
    light = (S + rho * np.array([0, 1, *shares])[:, np.newaxis]) * np.array(exposures)[:, np.newaxis]
    light += noise * random.standard_normal(light.shape)
    codes = np.rint(255 * encoded(np.clip(light, 0, 1).astype(np.float32), tone)) / 255
    return codes.astype(np.float32)


def halftones(codes: Floats, exposures: tuple[float, ...] = (1.0,) * 5) -> HalfTones:
    black, white, *tones = (
        Shown(part[np.newaxis], np.array([exposure])) for part, exposure in zip(codes, exposures, strict=True)
    )
    return HalfTones(black, white, tones, SHARES)


def fit(codes: Floats, exposures: tuple[float, ...] = (1.0,) * 5) -> Curve | None:
    return fit_camera_curve(halftones(codes, exposures)).curve


def shares_at(zoom: float, gamma: float, by: Image.Resampling) -> tuple[float, ...]:
    """The share of white's light that half-tones have if a page or a player draws them at another size."""
    part = Halftone(kind="halftone", levels=SHARES)
    monitor = Monitor(width=320, height=240, response="unknown")
    drawn = [
        Image.fromarray(part.values(n, monitor)[..., 0]).resize((round(320 * zoom), round(240 * zoom)), by)
        for n in range(part.count)
    ]
    return tuple(float((np.clip(np.asarray(picture), 0, 1) ** gamma).mean()) for picture in drawn)


def encoded(light: Floats, tone: Curve | str) -> Floats:
    if tone == "contrasty":
        x = from_light(light, "srgb")
        return 0.5 * x + 0.5 * x**2 * (3 - 2 * x)
    return light ** np.float32(1 / tone.gamma) if isinstance(tone, Gamma) else from_light(light, tone)  # type: ignore[arg-type]


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_an_s_shaped_curve_is_found(noise: float) -> None:
    found = fit(seen("contrasty", noise=noise))
    assert isinstance(found, Sampled)
    light = np.linspace(0.02, 0.8, 50, dtype=np.float32)
    back = to_light(encoded(light, "contrasty"), found)
    scale = (back @ light) / (light @ light)  # brighter than the brightest pixel nothing is known
    assert scale == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(back / scale, light, atol=0.01)
    assert np.abs(to_light(encoded(light, "contrasty"), "srgb") - light).max() > 0.05


@pytest.mark.parametrize("gain", [0.15, 0.3, 0.6, 0.9])
def test_dark_frames_of_a_contrasty_camera_have_their_brightness(gain: float) -> None:
    found = fit(seen("contrasty", 0.002, (gain,) * 5))
    light = np.linspace(0.1, 0.8, 50, dtype=np.float32) * gain
    back = to_light(encoded(light, "contrasty"), found)  # type: ignore[arg-type]
    scale = (back @ light) / (light @ light)
    assert scale == pytest.approx(1, abs=0.05)  # by the slopes of sRGB up to 1.15
    np.testing.assert_allclose(back / scale, light, atol=0.02 * gain)


@pytest.mark.parametrize("tone", ["linear", "srgb"])
def test_a_named_curve_is_named(tone: str) -> None:
    assert fit(seen(tone, noise=0.003)) == tone


def test_a_gamma_is_found() -> None:
    found = fit(seen(Gamma(gamma=1.8)))
    light = np.linspace(0.05, 0.8, 50, dtype=np.float32)
    back = to_light(encoded(light, Gamma(gamma=1.8)), found)  # type: ignore[arg-type]
    np.testing.assert_allclose(back / (back @ light) * (light @ light), light, atol=0.015)


def test_exposures_that_changed_are_evened_out() -> None:
    exposures = (1.05, 0.95, 1.03, 1.0, 0.97)
    assert fit(seen("srgb", 0.002, exposures), exposures) == "srgb"
    assert fit(seen("srgb", 0.002, exposures)) != "srgb"


def test_an_error_of_one_exposure_hardly_changes_the_curve() -> None:
    found = fit(seen("contrasty", 0.003, (1.0, 1.0, 1.0, 1.0, 1.03)))
    light = np.linspace(0.02, 0.8, 50, dtype=np.float32)
    back = to_light(encoded(light, "contrasty"), found)  # type: ignore[arg-type]
    np.testing.assert_allclose(back / (back @ light) * (light @ light), light, atol=0.006)


def test_pixels_that_do_not_follow_the_half_tones_are_left_out() -> None:
    codes = seen("contrasty")
    random = np.random.default_rng(5)
    border = np.where(random.random((5, 4000)) < 0.5, 0.1, 0.9)
    alone, both = fit(codes), fit(np.concatenate([codes, border], axis=1).astype(np.float32))
    assert isinstance(alone, Sampled)
    assert isinstance(both, Sampled)
    np.testing.assert_allclose(both.light, alone.light, atol=0.01)


def test_channels_have_curves_of_their_own_where_one_does_not_explain_them() -> None:
    # As raw values of a camera whose red and blue have powers 5 % apart from green's.
    powers = (1.05, 1.0, 1 / 1.05)
    codes = seen("contrasty", 0.003)
    coloured = np.stack([codes**power for power in powers], axis=2).reshape(5, -1).astype(np.float32)
    found = fit_camera_curve(halftones(coloured), channels=3).curve
    assert isinstance(found, tuple)
    light = np.linspace(0.02, 0.8, 50, dtype=np.float32)
    scales = []
    for own, power in zip(found, powers, strict=True):
        back = to_light(encoded(light, "contrasty") ** np.float32(power), own)
        scales.append((back @ light) / (light @ light))
        np.testing.assert_allclose(back / scales[-1], light, atol=0.01)
    assert np.ptp(scales) < 0.02  # so grey stays grey
    assert not isinstance(fit(coloured), tuple)


@pytest.mark.parametrize("tone", ["srgb", "contrasty"])
def test_channels_that_are_alike_have_one_curve(tone: str) -> None:
    three = np.stack([seen(tone, 0.003)] * 3, axis=2)
    three += np.float32(0.002) * np.random.default_rng(7).standard_normal(three.shape, np.float32)
    coloured = halftones(np.ascontiguousarray(three.reshape(5, -1)))
    assert fit_camera_curve(coloured, channels=3) == fit_camera_curve(coloured)


def test_too_few_or_too_dark_values_tell_nothing() -> None:
    codes = seen("srgb")
    assert fit(codes[:, :300]) is None
    assert fit(np.float32(0.2) * codes) is None


@pytest.mark.parametrize("tone", ["srgb", "contrasty"])
@pytest.mark.parametrize(
    ("zoom", "gamma", "by"),
    [
        (0.8, 2.2, Image.Resampling.BILINEAR),
        (1.1, 2.3, Image.Resampling.BILINEAR),
        (1.25, 2.1, Image.Resampling.BICUBIC),
        (2.0, 2.2, Image.Resampling.BILINEAR),
    ],
)
def test_scaled_half_tones_are_recognised_and_still_tell_the_curve(
    tone: str, zoom: float, gamma: float, by: Image.Resampling
) -> None:
    shares = shares_at(zoom, gamma, by)
    found = fit_camera_curve(halftones(seen(tone, 0.003, shares=shares)))
    assert found.scaled
    light = np.linspace(0.05, 0.8, 50, dtype=np.float32)
    back = to_light(encoded(light, tone), found.curve)  # type: ignore[arg-type]
    scale = (back @ light) / (light @ light)
    assert np.abs(back / scale - light).max() < 0.05
    linear = halftones(seen("linear", 0.003, shares=shares))
    assert are_scaled(linear, np.linspace(0, 1, 256, dtype=np.float32))


@pytest.mark.parametrize("tone", ["linear", "srgb", "contrasty", Gamma(gamma=1.6), Gamma(gamma=2.6)])
def test_no_curve_is_taken_for_scaled_half_tones(tone: Curve | str) -> None:
    assert not fit_camera_curve(halftones(seen(tone, 0.003))).scaled
    if tone in ("linear", "srgb"):
        look_up = to_light(np.linspace(0, 1, 256, dtype=np.float32), tone)  # type: ignore[arg-type]
        assert not are_scaled(halftones(seen(tone, 0.003)), look_up)
