"""Tone curves: they invert each other, and are the standard's."""

import numpy as np
import pytest

from workflows.images.tone_curves import (
    BLACK,
    Curve,
    Gamma,
    from_light,
    light_of_codes,
    table,
    to_light,
)


def f32(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def test_srgb_is_the_standards() -> None:
    # IEC 61966-2-1: the ends of the straight part, and light that is computed with a pocket calculator.
    encoded = f32(0, 0.02, 0.04045, 0.5, 1, 188 / 255)
    light = to_light(encoded, "srgb")
    np.testing.assert_allclose(light, [0, 0.02 / 12.92, 0.0031308, 0.21404114, 1, 0.50288646], rtol=2e-5)
    assert light.dtype == np.float32


def test_each_channel_has_its_curve_where_there_are_three() -> None:
    codes = np.random.default_rng(2).integers(0, 256, (4, 5, 3), np.uint8)
    curves: tuple[Curve, Curve, Curve] = ("linear", "srgb", Gamma(gamma=1.8))
    light = light_of_codes(codes, table(curves, codes.dtype))
    assert light.dtype == np.float32
    for channel, curve in enumerate(curves):
        own = light_of_codes(codes[..., channel], table(curve, codes.dtype))
        np.testing.assert_array_equal(light[..., channel], own)


@pytest.mark.parametrize("curve", ["linear", "srgb"])
def test_curves_invert_each_other(curve: str) -> None:
    values = np.linspace(0, 1, 4097, dtype=np.float32)
    there = to_light(values, curve)  # type: ignore[arg-type]
    np.testing.assert_allclose(from_light(there, curve), values, atol=2e-6)  # type: ignore[arg-type]
    assert np.all(np.diff(there) > 0)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_code_is_unchanged_by_light_and_back(dtype: str) -> None:
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


@pytest.mark.parametrize("curve", ["linear", "srgb"])
def test_black_value_is_zero_light_and_lower_values_are_negative(curve: Curve) -> None:
    made = table(curve, np.dtype(np.uint16), BLACK)
    assert made[BLACK] == 0
    assert made[65535] == pytest.approx(1)
    assert np.all(np.diff(made) > 0)
