import numpy as np
import pytest

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import estimate_crosstalk, estimate_noise, fit_photometry

NOISE = NoiseModel(4e-6, 5e-5)


def constants(n, k=8, noise=NOISE, seed=0, frames=1):
    rng = np.random.default_rng(seed)
    levels = np.repeat(np.linspace(0, 1, k)[:, None], 3, axis=1).astype(np.float32)
    S, rho = rng.uniform(0.01, 0.05, (n, 3)), rng.uniform(0.1, 0.9, (n, 3))
    clean = S[:, None] + rho[:, None] * levels
    error = np.sqrt(noise.variance(clean) / frames) * rng.standard_normal(clean.shape)
    return (clean + error).astype(np.float32), levels, S, rho


def test_fit_is_weighted_least_squares():
    values, levels, S, rho = constants(5)
    frames = np.array([1, 2, 1, 4, 1, 1, 3, 1])
    worth = np.broadcast_to(frames[:, None], values.shape).astype(np.float32)
    fit = fit_photometry(PatternLight.of(values)._replace(worth=worth), levels, NOISE)
    for p in range(5):
        for c in range(3):
            design = np.stack([np.ones(8), levels[:, c]], axis=1)
            even = np.sqrt(frames)
            first = np.linalg.lstsq(design * even[:, None], values[p, :, c] * even, rcond=None)[0]
            root = even / np.sqrt(NOISE.variance(design @ first))
            design *= root[:, None]
            expected = np.linalg.lstsq(design, values[p, :, c] * root, rcond=None)[0]
            np.testing.assert_allclose([fit.S[p, c], fit.rho[p, c]], expected, atol=2e-6)
            (black, both), (_, slope) = np.linalg.inv(design.T @ design)
            np.testing.assert_allclose(fit.black_variance[p, c], black, rtol=1e-5)
            np.testing.assert_allclose(fit.white_variance[p, c], black + 2 * both + slope, rtol=1e-5)
    np.testing.assert_allclose(fit.S, S, atol=0.01)
    np.testing.assert_allclose(fit.rho, rho, atol=0.03)
    assert fit.S.dtype == fit.rho.dtype == np.float32


def test_lit_and_dark_parts_of_a_border_weigh_alike():
    black, white = [0.02, 0.48, 0.48], [0.23, 0.69, 0.69]
    values = np.repeat(np.array(black + white, np.float32)[np.newaxis, :, np.newaxis], 3, axis=2)
    levels = np.repeat(np.repeat([0, 1], 3)[:, np.newaxis], 3, axis=1).astype(np.float32)
    fit = fit_photometry(PatternLight.of(values), levels, NOISE)
    np.testing.assert_allclose(fit.S, np.mean(black), atol=1e-6)
    np.testing.assert_allclose(fit.S + fit.rho, np.mean(white), atol=1e-6)


def test_clipped_levels_are_left_out():
    values, levels, _, _ = constants(4)
    usable = np.ones(values.shape, bool)
    usable[:, 6:, 1] = False
    clipped = values.copy()
    clipped[:, 6:, 1] = 0.1
    expected = fit_photometry(PatternLight.of(values[:, :6]), levels[:6], NOISE)
    fit = fit_photometry(PatternLight.of(clipped, usable), levels, NOISE)
    np.testing.assert_allclose(fit.rho[:, 1], expected.rho[:, 1], rtol=1e-6)


def test_all_levels_serve_where_fewer_than_two_usable_ones_differ():
    values, levels, _, _ = constants(1)
    usable = np.zeros(values.shape, bool)
    usable[:, 3] = True
    fit = fit_photometry(PatternLight.of(values, usable), levels, NOISE)
    whole = fit_photometry(PatternLight.of(values), levels, NOISE)
    np.testing.assert_array_equal(fit.rho, whole.rho)


def test_a_dead_channel_has_rho_zero_and_the_mean_as_s():
    values, levels, _, _ = constants(1)
    values[0, :, 2] = np.linspace(0.04, 0.02, 8)
    fit = fit_photometry(PatternLight.of(values), levels, NoiseModel(1e-6, 0))
    assert fit.rho[0, 2] == 0
    assert fit.S[0, 2] == pytest.approx(0.03)


def test_one_level_is_refused():
    with pytest.raises(ValueError, match="two different"):
        fit_photometry(PatternLight.of(np.ones((1, 2, 3), np.float32)), np.ones((2, 3), np.float32), NOISE)


def test_shapes_that_do_not_fit_are_refused():
    values, levels, _, _ = constants(2)
    with pytest.raises(ValueError, match="do not match"):
        estimate_noise(values, levels[:4], np.ones(values.shape, bool), 1 / 255)
    with pytest.raises(ValueError, match="do not match"):
        estimate_crosstalk(values, levels[:4], np.ones(values.shape, bool))


def test_noise_is_recovered():
    values, levels, _, _ = constants(3000, seed=3)
    usable = np.ones(values.shape, bool)
    usable[:, 0, 0] = False
    values[:, 0, 0] = 0
    found = estimate_noise(values, levels, usable, 0.0)
    for v in (0.02, 0.3, 0.8):
        assert found.variance(np.float32(v)) == pytest.approx(NOISE.variance(np.float32(v)), rel=0.12)


def test_noise_is_not_hidden_by_a_black_that_is_clipped():
    true, step = NoiseModel(5e-6, 6e-5), 1 / 255
    random = np.random.default_rng(0)
    levels = np.repeat(np.array([0.0, 1.0], np.float32), 4)[:, np.newaxis] * np.ones(3, np.float32)
    black = np.where(np.arange(4000) % 4 == 0, 4, 1)[:, np.newaxis, np.newaxis] * step  # most are near 0
    light = black + 0.7 * levels
    noisy = light + np.sqrt(true.variance(light)) * random.standard_normal(light.shape)
    codes = np.clip(np.round(noisy / step), 0, 255)
    found = estimate_noise((codes * step).astype(np.float32), levels, codes > 0, step)
    for v in (0.02, 0.7):
        expected = true.variance(np.float32(v)) + step**2 / 12
        assert found.variance(np.float32(v)) == pytest.approx(expected, rel=0.15)


def test_noise_withstands_a_few_wild_pixels():
    values, levels, _, _ = constants(3000, seed=4)
    values[::50] += np.random.default_rng(0).normal(0, 0.2, values[::50].shape).astype(np.float32)
    found = estimate_noise(values, levels, np.ones(values.shape, bool), 0.0)
    assert found.variance(np.float32(0.4)) == pytest.approx(NOISE.variance(np.float32(0.4)), rel=0.15)


def test_noise_of_few_levels_is_that_of_a_typical_sensor():
    values, levels, _, _ = constants(500, k=3)
    found = estimate_noise(values, levels, np.ones(values.shape, bool), 1 / 255)
    assert found.shot == 1 / 20_000
    assert found.read == pytest.approx(0.0015**2 + (1 / 255) ** 2 / 12)


def test_noise_is_never_below_the_quantisation():
    values, levels, _, _ = constants(500, noise=NoiseModel(0, 0))
    found = estimate_noise(values, levels, np.ones(values.shape, bool), 1 / 255)
    assert found.read >= (1 / 255) ** 2 / 12
    assert found.variance(np.zeros(1)).dtype == np.float32


COLOURS = np.concatenate([np.eye(3), np.ones((1, 3)), np.zeros((1, 3))]).astype(np.float32)


@pytest.mark.parametrize("flicker", [0, 0.2])
def test_crosstalk_is_recovered(flicker: float) -> None:
    rng = np.random.default_rng(0)
    lit = COLOURS * (1 + flicker * np.linspace(-1, 1, len(COLOURS))[:, np.newaxis])
    crosstalk = np.array([[1, 0.1, 0.02], [0.05, 1, 0.2], [0, 0.15, 1]])
    rho = rng.uniform(0.1, 0.9, (40, 1, 3))
    values = 0.02 + (rho * lit) @ crosstalk.T + rng.normal(0, 0.002, (40, 5, 3))
    usable = np.ones(values.shape, bool)
    values[3, 2, 1], usable[3, 2, 1] = 1, False
    found = estimate_crosstalk(values.astype(np.float32), COLOURS, usable)
    np.testing.assert_allclose(found, crosstalk, atol=3e-3)


@pytest.mark.parametrize("why", ["grey", "clipped", "dark", "no colours"])
def test_crosstalk_without_evidence_is_the_identity(why):
    rho = np.random.default_rng(0).uniform(0.1, 0.9, (40, 1, 3))
    levels = np.repeat(np.linspace(0, 1, 5)[:, None], 3, axis=1) if why == "grey" else COLOURS
    crosstalk = np.ones((3, 3)) / 3 if why == "no colours" else np.eye(3)
    values = np.zeros((40, 5, 3)) if why == "dark" else (rho * levels) @ crosstalk.T
    usable = np.full(values.shape, why != "clipped")
    found = estimate_crosstalk(values.astype(np.float32), levels.astype(np.float32), usable)
    np.testing.assert_array_equal(found, np.eye(3))


def test_crosstalk_of_a_camera_that_clips_negative_light() -> None:
    random = np.random.default_rng(6)
    true = np.array([[1, -0.1, -0.08], [-0.05, 1, -0.07], [-0.06, -0.1, 1]])
    levels = np.array([[1, 1, 1], [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    rho, S = random.uniform(0.1, 0.8, (2000, 1, 3)), 0.02
    values = (S + (rho * levels) @ true.T).astype(np.float32)
    clipped = np.maximum(values, 0)
    found = estimate_crosstalk(clipped, levels, clipped > 0)
    np.testing.assert_allclose(found.sum(axis=1), true.sum(axis=1), atol=0.02)
    np.testing.assert_allclose(found, true, atol=0.04)
    np.testing.assert_allclose(estimate_crosstalk(values, levels, values > -1), true, atol=0.001)
