"""Stray light: added, taken out, and found beside a T that is recovered as if there were none."""

import numpy as np
import pytest

from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.lobes.recover import recover
from workflows.recovery.lobes.strays import find_strong_strays, subtract_strays, write_strays
from workflows.recovery.normalise import Conditions

COLUMNS, ROWS = 64, 48
BANDS = [(8, 6, 24), (16, 12, 24), (32, 24, 24), (COLUMNS, ROWS, 24)]


def test_amounts_of_each_group_are_added() -> None:
    strays = np.array([[1, 1, 1], [1, -1, 0.5]], np.float32)
    f = np.full(6, np.nan, np.float32)
    write_strays(strays, np.array([0.1, 0.2, 0.3, 0.4]), 0, f)
    np.testing.assert_allclose(f, [0.3, -0.1, 0.2, 0.7, -0.1, 0.5], rtol=1e-6)
    write_strays(strays, np.array([0.1, 0.2, 0.3, 0.4]), 1, f)
    np.testing.assert_allclose(f, [0.2, -0.2, 0.1, 0.4, -0.4, 0.2], rtol=1e-6)


def test_what_is_left_is_normalised_again() -> None:
    plain = np.array([0.3, -0.5, -1, 1], np.float32)
    stray = np.array([0.1, -0.1, 0.02, -0.04], np.float32)
    y, variance = plain + stray, np.full(4, 1e-4, np.float32)
    subtract_strays(y, variance, stray, 4)
    np.testing.assert_allclose(y, plain, atol=1e-6)
    np.testing.assert_allclose(variance, 1e-4, rtol=1e-5)
    squeezed = 0.9 * plain + 0.05 + stray
    subtract_strays(squeezed, variance, stray, 4)
    np.testing.assert_allclose(squeezed, plain, atol=1e-6)
    np.testing.assert_allclose(variance, 1e-4 / 0.81, rtol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_t_is_recovered_beside_stray_light(patterns_of, gaussian, observe, channels: int) -> None:
    shown = patterns_of(BANDS, 1, channels=channels)
    T = np.concatenate([gaussian(COLUMNS, ROWS, x, 20.6, 1.5, 1.0) for x in (14.6, 30.2, 45.3)])
    plain, photometry, noise = observe(shown, T)
    rng = np.random.default_rng(0)
    lit = np.sign(rng.standard_normal((4, shown.count + 2))).astype(np.float32)
    lit -= lit[:, :-2].mean(axis=1, keepdims=True)
    strays = np.concatenate([np.ones((1, lit.shape[1]), np.float32), lit])
    amount = rng.uniform(-0.03, 0.03, (3, 1, 4)) * photometry.rho[..., np.newaxis]
    light = amount @ lit
    seen = PatternLight.of(plain.values + light[..., :-2].transpose(0, 2, 1).astype(np.float32))
    from_constants = type(photometry)(
        (photometry.S + light[..., -2]).astype(np.float32),
        (photometry.rho + light[..., -1] - light[..., -2]).astype(np.float32),
        photometry.black_variance,
        photometry.white_variance,
    )
    clean = recover(plain, photometry, shown, noise)
    beside = recover(seen, from_constants, shown, noise, conditions=Conditions(strays=strays))
    ignored = recover(seen, from_constants, shown, noise)
    np.testing.assert_allclose(beside.photometry.S, clean.photometry.S, atol=2e-3)
    np.testing.assert_allclose(beside.photometry.rho, clean.photometry.rho, atol=4e-3)
    assert beside.stray is not None
    np.testing.assert_allclose(beside.stray, light[..., :-2].transpose(0, 2, 1), atol=6e-3)
    assert clean.stray is None
    backdrop = np.sin(np.arange(COLUMNS) / 5)[np.newaxis, :, np.newaxis] * np.ones((ROWS, 1, 3)) / 2 + 0.5
    nodes = shown.pyramid.light(backdrop.astype(np.float32))

    def error(found) -> float:
        composite = found.photometry.S + found.photometry.rho * found.transport.apply(nodes)
        expected = photometry.S + photometry.rho * (T @ backdrop.reshape(-1, 3)[:, :1])[..., 0]
        return float(np.sqrt(np.mean((composite - expected) ** 2)))

    assert error(beside) < 2 * error(clean)
    assert error(beside) < error(ignored) / 3


def test_a_pixel_that_sees_the_border_keeps_its_mean_light() -> None:
    random = np.random.default_rng(4)
    m = 128
    bits = np.where(random.random((7, m + 6)) < 0.5, 1.0, -1.0)
    bits -= bits.mean(axis=1, keepdims=True)
    shown = np.concatenate([random.random(m), [0, 0, 0, 1, 1, 1]])
    S, rho = np.array([0.2, 0.2, 0.05]), np.array([0.0, 0.02, 0.6])
    amount = np.array([0.1, 0.08, 0.0])[:, np.newaxis] * random.standard_normal((3, 7))
    light = S[:, np.newaxis] + rho[:, np.newaxis] * shown + amount @ bits
    ends = bits[:, m:].reshape(7, 2, 3).mean(axis=2)  # S and rho come from three black and three white frames
    black, white = light[:, m:].reshape(3, 2, 3).mean(axis=2).T
    rows = np.concatenate([np.ones((1, m + 2)), np.concatenate([bits[:, :m], ends], axis=1)])
    three = np.ones(3, np.float32)
    given = Photometry(
        *(
            (values[:, np.newaxis] * three).astype(np.float32)
            for values in (black, white - black, np.full(3, 1e-6), np.full(3, 1e-6))
        )
    )
    values = (light[:, :m, np.newaxis] * three).astype(np.float32)
    stray, found = find_strong_strays(PatternLight.of(values), given, rows.astype(np.float32))
    left = values - stray
    np.testing.assert_allclose(found.S[:, 0], S, atol=0.01)
    np.testing.assert_allclose(found.rho[:, 0], rho, atol=0.01)
    clean = S[:, np.newaxis] + rho[:, np.newaxis] * shown[:m]
    np.testing.assert_allclose(left[..., 0], clean, atol=0.01)
    assert found.S[2, 0] == given.S[2, 0]  # what sees the patterns is left to the fit of its lobes
    np.testing.assert_array_equal(left[2], values[2])
    assert abs(given.S[0, 0] - S[0]) > 0.02


@pytest.mark.parametrize("m", [16, 24, 49, 128])
def test_what_explains_a_pixel_by_chance_is_left_to_its_lobes(m: int) -> None:
    random = np.random.default_rng(2)
    bits = np.where(random.random((6, m + 2)) < 0.5, 1, -1).astype(np.float32)
    rows = np.concatenate([np.ones((1, m + 2), np.float32), bits])
    n = 2000
    values = (0.1 + 0.5 * (random.random((n, m, 1)) < 0.5) * np.ones(3)).astype(np.float32)
    usable = np.ones(values.shape, bool)
    usable[: n // 2, m // 2 :] = False
    S, rho, variance = (np.full((n, 3), value, np.float32) for value in (0.1, 0.5, 1e-6))
    light = PatternLight.of(values, usable)
    photometry = Photometry(S, rho, variance, variance)
    stray, _ = find_strong_strays(light, photometry, rows)
    assert stray[: n // 2].any(axis=(1, 2)).mean() < 0.02
    assert stray[n // 2 :].any(axis=(1, 2)).mean() < 0.02
    half = slice(n // 2)
    alone, _ = find_strong_strays(light.of_pixels(half), photometry.of_pixels(half), rows)
    np.testing.assert_array_equal(alone, stray[: n // 2])
