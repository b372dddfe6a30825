"""Unknown curves, found from what a camera stored of constant levels."""

from typing import Literal

import numpy as np
import pytest

from workflows.images.tone_curves import Curve, Gamma, Response, from_light, to_light
from workflows.ingest.camera.curve_estimate import Estimate, estimate


def f32(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def stored(levels: np.ndarray, monitor: Curve, camera_gamma: float, noise: float = 0.002) -> np.ndarray:
    """(k, n) values that a camera of this gamma stores of 500 pixels, S and rho of each its own."""
    rng = np.random.default_rng(5)
    S, rho = rng.uniform(0.02, 0.1, 500), rng.uniform(0.2, 0.8, 500)
    light = S + rho * to_light(levels, monitor).astype(np.float64)[:, None]
    light += rng.normal(0, noise, light.shape)
    return (np.maximum(light, 1e-4) ** (1 / camera_gamma)).astype(np.float32)


LEVELS = np.linspace(0, 1, 9, dtype=np.float32)


def estimated(
    levels: np.ndarray,
    values: np.ndarray,
    monitor: Response,
    camera: Response,
    exposures: np.ndarray | None = None,
) -> Estimate:
    usable = (values > 0) & (values < 0.9999)
    return estimate(
        levels, np.ones_like(levels) if exposures is None else exposures, values, usable, monitor, camera
    )


@pytest.mark.parametrize("gamma", [0.8, 1.5, 1.8, 2.4])
def test_the_cameras_gamma_is_found(gamma: float) -> None:
    found = estimated(LEVELS, stored(LEVELS, "srgb", gamma), "srgb", "unknown")
    assert found.monitor == "srgb"
    assert isinstance(found.camera, Gamma)
    assert found.camera.gamma == pytest.approx(gamma, abs=0.05)
    assert found.assumed == ()


@pytest.mark.parametrize("curve", ["linear", "srgb"])
@pytest.mark.parametrize("bits", [8, 16])
def test_the_cameras_curve_is_recognised(curve: Literal["linear", "srgb"], bits: int) -> None:
    light = stored(LEVELS, "srgb", 1.0)
    values = np.rint(from_light(light, curve) * (2**bits - 1)) / np.float32(2**bits - 1)
    assert estimated(LEVELS, values, "srgb", "unknown") == ("srgb", curve, ())


@pytest.mark.parametrize("gamma", [1.4, 1.8, 2.6])
def test_the_monitors_gamma_is_found(gamma: float) -> None:
    values = stored(LEVELS, Gamma(gamma=gamma), 2.2)
    found = estimated(LEVELS, values, "unknown", Gamma(gamma=2.2))
    assert found.camera == Gamma(gamma=2.2)
    assert isinstance(found.monitor, Gamma)
    assert found.monitor.gamma == pytest.approx(gamma, abs=0.05)


@pytest.mark.parametrize(
    ("levels", "declared", "found"),
    [
        (LEVELS, ("unknown", "unknown"), ("srgb", "srgb", ("camera", "monitor"))),
        (f32(0, 1), ("linear", "unknown"), ("linear", "srgb", ("camera",))),
        (f32(0, 1, 1, 0), ("unknown", "linear"), ("srgb", "linear", ("monitor",))),
        (LEVELS, ("linear", "srgb"), ("linear", "srgb", ())),
        (LEVELS, (Gamma(gamma=1.7), "linear"), (Gamma(gamma=1.7), "linear", ())),
    ],
)
def test_unknown_curves_count_as_srgb_and_known_ones_are_kept(
    levels: np.ndarray, declared: tuple[Response, Response], found: tuple[Curve, Curve, tuple[str, ...]]
) -> None:
    assert estimated(levels, stored(levels, "linear", 1.5), *declared) == found


@pytest.mark.parametrize(("camera", "gamma"), [("srgb", 2.2), ("linear", 1.6), (2.6, 1.8)])
def test_exposures_tell_both_curves(camera: Literal["linear", "srgb"] | float, gamma: float) -> None:
    levels, exposures = np.tile(LEVELS, 3), np.repeat(f32(1, 3, 9), len(LEVELS))
    rng = np.random.default_rng(5)
    S, rho = rng.uniform(0.01, 0.02, 500), rng.uniform(0.1, 0.5, 500)
    light = exposures[:, None] * (S + rho * to_light(levels, Gamma(gamma=gamma)).astype(np.float64)[:, None])
    light = np.clip(light + rng.normal(0, 0.001, light.shape), 0, 1).astype(np.float32)
    values = from_light(light, camera) if isinstance(camera, str) else light ** np.float32(1 / camera)
    found = estimated(levels, values, "unknown", "unknown", exposures)
    assert found.assumed == ()
    assert isinstance(found.monitor, Gamma)
    assert found.monitor.gamma == pytest.approx(gamma, abs=0.05)
    if isinstance(camera, str):
        assert found.camera == camera
    else:
        assert isinstance(found.camera, Gamma)
        assert found.camera.gamma == pytest.approx(camera, abs=0.05)


def test_two_levels_at_two_exposures_tell_the_camera() -> None:
    levels, exposures = f32(0, 1, 0, 1), f32(1, 1, 2, 2)
    rng = np.random.default_rng(5)
    light = exposures[:, None] * (0.05 + 0.4 * levels[:, None] * rng.uniform(0.2, 1, 500))
    values = from_light(light.astype(np.float32), "srgb")
    assert estimated(levels, values, "unknown", "unknown", exposures) == ("srgb", "srgb", ("monitor",))


def test_no_usable_pixel_is_srgb() -> None:
    assert estimated(LEVELS, np.zeros((9, 0), np.float32), "linear", "unknown").camera == "srgb"
    assert estimated(LEVELS, np.zeros((9, 50), np.float32), "linear", "unknown").camera == "srgb"


def test_camera_without_contrast_gets_a_default_curve() -> None:
    values = np.full((9, 50), 0.25, np.float32)
    assert estimated(LEVELS, values, "linear", "unknown") == ("linear", "srgb", ("camera",))
