"""Tone curves: they invert each other, are the standard's, and are found from what a camera stored."""

import numpy as np
import pytest

from workflows.tone import Curve, Gamma, Response, estimate, from_light, table, to_light


def f32(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def test_srgb_is_the_standards() -> None:
    # IEC 61966-2-1: the ends of the straight part, and light that is computed with a pocket calculator.
    encoded = f32(0, 0.02, 0.04045, 0.5, 1, 188 / 255)
    light = to_light(encoded, "srgb")
    np.testing.assert_allclose(light, [0, 0.02 / 12.92, 0.0031308, 0.21404114, 1, 0.50288646], rtol=2e-5)
    assert light.dtype == np.float32


@pytest.mark.parametrize("curve", ["linear", "srgb"])
def test_curves_invert_each_other(curve: str) -> None:
    values = np.linspace(0, 1, 4097, dtype=np.float32)
    there = to_light(values, curve)  # type: ignore[arg-type]
    np.testing.assert_allclose(from_light(there, curve), values, atol=2e-6)  # type: ignore[arg-type]
    assert np.all(np.diff(there) > 0)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_a_code_survives_the_way_to_light_and_back(dtype: str) -> None:
    codes = np.arange(np.iinfo(dtype).max + 1)
    back = from_light(table("srgb", np.dtype(dtype)), "srgb") * np.float32(codes[-1])
    np.testing.assert_array_equal(np.rint(back), codes)


def test_a_gamma_is_a_power() -> None:
    np.testing.assert_allclose(to_light(f32(0, 0.5, 1), Gamma(gamma=2.5)), [0, 0.5**2.5, 1], rtol=1e-6)
    np.testing.assert_array_equal(to_light(f32(-0.1), Gamma(gamma=2.5)), [0])
    with pytest.raises(ValueError, match="less than or equal to 5"):
        Gamma(gamma=6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_a_table_has_the_light_of_every_value(dtype: str) -> None:
    made = table("srgb", np.dtype(dtype))
    top = np.iinfo(dtype).max
    assert made.shape == (top + 1,)
    assert made.dtype == np.float32
    assert made[0] == 0
    assert made[top] == pytest.approx(1)
    assert made[top // 2] == pytest.approx(float(to_light(f32((top // 2) / top), "srgb")[0]))


def stored(levels: np.ndarray, monitor: Curve, camera_gamma: float, noise: float = 0.002) -> np.ndarray:
    """(k, n) values that a camera of this gamma stores of 500 pixels, S and rho of each its own."""
    rng = np.random.default_rng(5)
    S, rho = rng.uniform(0.02, 0.1, 500), rng.uniform(0.2, 0.8, 500)
    light = S + rho * to_light(levels, monitor).astype(np.float64)[:, None]
    light += rng.normal(0, noise, light.shape)
    return (np.maximum(light, 1e-4) ** (1 / camera_gamma)).astype(np.float32)


LEVELS = np.linspace(0, 1, 9, dtype=np.float32)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.4])
def test_the_cameras_gamma_is_found(gamma: float) -> None:
    monitor, camera = estimate(LEVELS, stored(LEVELS, "srgb", gamma), "srgb", "unknown")
    assert monitor == "srgb"
    assert isinstance(camera, Gamma)
    assert camera.gamma == pytest.approx(gamma, abs=0.05)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_the_monitors_gamma_is_found(gamma: float) -> None:
    values = stored(LEVELS, Gamma(gamma=gamma), 2.2)
    monitor, camera = estimate(LEVELS, values, "unknown", Gamma(gamma=2.2))
    assert camera == Gamma(gamma=2.2)
    assert isinstance(monitor, Gamma)
    assert monitor.gamma == pytest.approx(gamma, abs=0.05)


@pytest.mark.parametrize(
    ("levels", "said", "found"),
    [
        (LEVELS, ("unknown", "unknown"), ("srgb", "srgb")),
        (f32(0, 1), ("linear", "unknown"), ("linear", "srgb")),
        (f32(0, 1, 1, 0), ("unknown", "linear"), ("srgb", "linear")),
        (LEVELS, ("linear", "srgb"), ("linear", "srgb")),
        (LEVELS, (Gamma(gamma=1.7), "linear"), (Gamma(gamma=1.7), "linear")),
    ],
)
def test_what_can_not_be_told_is_srgb_and_what_is_known_stays(
    levels: np.ndarray, said: tuple[Response, Response], found: tuple[Curve, Curve]
) -> None:
    assert estimate(levels, stored(levels, "linear", 1.5), *said) == found


def test_no_usable_pixel_is_srgb() -> None:
    assert estimate(LEVELS, np.zeros((9, 0), np.float32), "linear", "unknown") == ("linear", "srgb")


def test_a_camera_that_saw_no_difference_gets_some_curve() -> None:
    values = np.full((9, 50), 0.25, np.float32)
    monitor, camera = estimate(LEVELS, values, "linear", "unknown")
    assert (monitor, camera) == ("linear", "srgb")
