from dataclasses import replace

import numpy as np
import pytest

from workflows.recovery.photometry import (
    Measured,
    Noise,
    Photometry,
    estimate_crosstalk,
    estimate_noise,
    expected_error,
    fit_photometry,
    normalise,
    refit,
)

NOISE = Noise(4e-6, 5e-5)


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
    fit = fit_photometry(values, levels, np.ones(values.shape, bool), NOISE, frames)
    for p in range(5):
        for c in range(3):
            root = np.sqrt(frames / NOISE.variance(values[p, :, c]))
            design = np.stack([np.ones(8), levels[:, c]], axis=1) * root[:, None]
            expected = np.linalg.lstsq(design, values[p, :, c] * root, rcond=None)[0]
            np.testing.assert_allclose([fit.S[p, c], fit.rho[p, c]], expected, atol=2e-6)
            (black, both), (_, slope) = np.linalg.inv(design.T @ design)
            np.testing.assert_allclose(fit.black[p, c], black, rtol=1e-5)
            np.testing.assert_allclose(fit.white[p, c], black + 2 * both + slope, rtol=1e-5)
    np.testing.assert_allclose(fit.S, S, atol=0.01)
    np.testing.assert_allclose(fit.rho, rho, atol=0.03)
    assert fit.S.dtype == fit.rho.dtype == np.float32


def test_clipped_levels_are_left_out():
    values, levels, _, _ = constants(4)
    usable = np.ones(values.shape, bool)
    usable[:, 6:, 1] = False
    clipped = values.copy()
    clipped[:, 6:, 1] = 0.1
    frames = np.ones(8, int)
    expected = fit_photometry(values[:, :6], levels[:6], usable[:, :6], NOISE, frames[:6])
    fit = fit_photometry(clipped, levels, usable, NOISE, frames)
    np.testing.assert_allclose(fit.rho[:, 1], expected.rho[:, 1], rtol=1e-6)


def test_all_levels_serve_where_fewer_than_two_usable_ones_differ():
    values, levels, _, _ = constants(1)
    usable = np.zeros(values.shape, bool)
    usable[:, 3] = True
    frames = np.ones(8, int)
    fit = fit_photometry(values, levels, usable, NOISE, frames)
    whole = fit_photometry(values, levels, np.ones_like(usable), NOISE, frames)
    np.testing.assert_array_equal(fit.rho, whole.rho)


def test_a_dead_channel_has_rho_zero_and_the_mean_as_s():
    values, levels, _, _ = constants(1)
    values[0, :, 2] = np.linspace(0.04, 0.02, 8)
    fit = fit_photometry(values, levels, np.ones(values.shape, bool), Noise(1e-6, 0), np.ones(8, int))
    assert fit.rho[0, 2] == 0
    assert fit.S[0, 2] == pytest.approx(0.03)


def test_one_level_is_refused():
    with pytest.raises(ValueError, match="two different"):
        fit_photometry(
            np.ones((1, 2, 3), np.float32),
            np.ones((2, 3), np.float32),
            np.ones((1, 2, 3), bool),
            NOISE,
            np.ones(2, int),
        )


def test_shapes_that_do_not_fit_are_refused():
    values, levels, _, _ = constants(2)
    with pytest.raises(ValueError, match="do not fit"):
        estimate_noise(values, levels[:4], np.ones(values.shape, bool), 1 / 255)
    with pytest.raises(ValueError, match="measurements"):
        normalise(values, Photometry(*np.ones((4, 3, 3), np.float32)), NOISE, 3.0)
    with pytest.raises(ValueError, match="do not fit"):
        estimate_crosstalk(values, levels[:4], np.ones(values.shape, bool))


@pytest.mark.parametrize("frames", [1, 4])
def test_noise_is_recovered(frames):
    values, levels, _, _ = constants(3000, frames=frames, seed=3)
    usable = np.ones(values.shape, bool)
    usable[:, 0, 0] = False
    values[:, 0, 0] = 0
    found = estimate_noise(values, levels, usable, 0.0, np.full(8, frames))
    for v in (0.02, 0.3, 0.8):
        assert found.variance(np.float32(v)) == pytest.approx(NOISE.variance(np.float32(v)), rel=0.12)


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
    values, levels, _, _ = constants(500, noise=Noise(0, 0))
    found = estimate_noise(values, levels, np.ones(values.shape, bool), 1 / 255)
    assert found.read >= (1 / 255) ** 2 / 12
    assert found.variance(np.zeros(1)).dtype == np.float32


@pytest.fixture
def photometry():
    """Two pixels; the third channel of the first sees nothing of the monitor."""
    S = np.full((2, 3), 0.1, np.float32)
    rho = np.array([[0.5, 0.8, 0.001], [0.4, 0.4, 0.4]], np.float32)
    return Photometry(S, rho, NOISE.variance(S) / 8, NOISE.variance(S + rho) / 8)


def test_normalise_gives_the_signed_form_and_its_variance(photometry):
    measurements = np.array([[[0.1, 0.9, 0.1], [0.6, 0.5, 0.1]], [[0.3] * 3] * 2], np.float32)
    value, variance = normalise(measurements, photometry, NOISE, 3.0)
    np.testing.assert_allclose(value[0], [[-1, 1, -1, 1], [1, 0, -1, 1], [0, 0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(value[1], [[0, 0, -1, 1]] * 3, atol=1e-6)
    seen = NOISE.variance(np.array([0.1, 0.6], np.float32))
    ends = [photometry.black[0, 0], photometry.white[0, 0]]
    np.testing.assert_allclose(variance[0, 0], 4 * np.append(seen, ends) / 0.5**2, rtol=1e-6)
    assert (variance[0, 2] == np.inf).all()
    assert (value.dtype, variance.dtype) == (np.float32, np.float32)


def test_what_says_nothing_has_an_infinite_variance(photometry):
    measurements = np.full((2, 4, 3), 0.3, np.float32)
    measurements[1, :2, 0] = np.nan, np.inf
    usable = np.ones(measurements.shape, bool)
    usable[1, 2, 0] = False
    value, variance = normalise(measurements, photometry, NOISE, 3.0, usable, np.array([1, 1, 1, 4]))
    assert np.isinf(variance[1, 0]).tolist() == [True, True, True, False, False, False]
    assert (value[1, 0, :3] == 0).all()
    assert np.isfinite(variance[1, 1:]).all()
    # four frames are four times as good
    np.testing.assert_allclose(variance[1, 1, 3], variance[1, 1, 0] / 4, rtol=1e-6)


def test_refit_is_weighted_least_squares_in_camera_values(photometry):
    # known too badly to hold the fit back
    photometry = replace(photometry, black=np.full((2, 3), 4e-4), white=np.full((2, 3), 4e-4))
    rng = np.random.default_rng(0)
    m, kappa = 30, np.zeros((2, 3))
    kappa[1, 1] = 0.05
    response = np.concatenate([rng.uniform(-1, 1, (2, 3, m)), np.tile([-1.0, 1.0], (2, 3, 1))], axis=2)
    response = response.astype(np.float32)
    light = (1 + response[:, :, :m].transpose(0, 2, 1)) / 2
    measurements = 0.01 + photometry.S[:, None] + 0.97 * photometry.rho[:, None] * light
    measurements += rng.normal(0, 0.01, measurements.shape)
    measurements[1, 3] = np.nan
    measured = normalise(measurements.astype(np.float32), photometry, NOISE, 3.0)
    fit = refit(photometry, measured, response, kappa)
    for p, c in [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]:
        light = (1 + response[p, c].astype(float)) / 2
        S, rho = photometry.S[p, c], photometry.rho[p, c]
        seen = np.append(measurements[p, :, c], [S, S + rho])
        variance = measured.variance[p, c] * rho**2 / 4
        variance[:m] += rho**2 / 4 * kappa[p, c] * (1 - response[p, c, :m] ** 2)
        there = np.isfinite(variance)
        root = 1 / np.sqrt(variance[there])
        design = np.stack([np.ones(there.sum()), light[there]], axis=1) * root[:, None]
        expected = np.linalg.lstsq(design, seen[there] * root, rcond=None)[0]
        np.testing.assert_allclose([fit.S[p, c], fit.rho[p, c]], expected, atol=1e-5)
    assert (fit.S[0, 2], fit.rho[0, 2]) == (photometry.S[0, 2], photometry.rho[0, 2])


def test_a_t_that_says_nothing_leaves_the_photometry(photometry):
    unknown = Measured(np.zeros((2, 3, 5), np.float32), np.full((2, 3, 5), np.inf, np.float32))
    flat = Measured(np.full((2, 3, 5), 0.3, np.float32), np.ones((2, 3, 5), np.float32))
    for measured in (unknown, flat):
        fit = refit(photometry, measured, np.zeros((2, 3, 5), np.float32), np.zeros((2, 3)))
        np.testing.assert_array_equal(fit.S, photometry.S)
        np.testing.assert_array_equal(fit.rho, photometry.rho)


def test_a_t_that_is_sure_of_itself_and_wrong_leaves_the_photometry(photometry):
    # one cell is predicted, but the light comes from two: half of the patterns are grey
    response = np.where(np.arange(24) % 2, 1, -1) * np.ones((2, 3, 1))
    value = np.where(np.arange(24) % 4 < 2, response, 0)
    ends = np.tile([-1.0, 1.0], (2, 3, 1))
    measured = Measured(
        np.concatenate([value, ends], axis=2).astype(np.float32), np.full((2, 3, 26), 1e-4, np.float32)
    )
    response = np.concatenate([response, ends], axis=2).astype(np.float32)
    fit = refit(photometry, measured, response, np.ones((2, 3)))
    black, white = (3 * np.sqrt(variance) for variance in (photometry.black, photometry.white))
    assert (np.abs(fit.S - photometry.S) <= black).all()
    assert (np.abs(fit.rho - photometry.rho) <= black + white).all()


def test_the_error_to_expect_is_the_misfits_in_camera_units(photometry):
    variance = np.full((2, 3, 6), 1e-3, np.float32)
    variance[1, 2] = np.inf
    measured = Measured(np.zeros((2, 3, 6), np.float32), variance)
    misfit = np.array([[0.04, 0.01, 0.02], [-0.1, 0.0, 0.0]])
    found = expected_error(photometry, measured, misfit)
    noise = 1e-3 / 6
    squares = photometry.rho.astype(float) ** 2 / 4 * [[0.04, 0.01, 0.02], [noise, noise, 0]]
    np.testing.assert_allclose(found, np.sqrt(squares.mean(axis=1)), rtol=1e-5)
    assert found.dtype == np.float32
    variance[:] = np.inf
    assert (expected_error(photometry, measured, misfit) == np.inf).all()


COLOURS = np.concatenate([np.eye(3), np.ones((1, 3)), np.zeros((1, 3))]).astype(np.float32)


def test_crosstalk_is_recovered():
    rng = np.random.default_rng(0)
    crosstalk = np.array([[1, 0.1, 0.02], [0.05, 1, 0.2], [0, 0.15, 1]])
    rho = rng.uniform(0.1, 0.9, (40, 1, 3))
    values = 0.02 + (rho * COLOURS) @ crosstalk.T + rng.normal(0, 0.002, (40, 5, 3))
    usable = np.ones(values.shape, bool)
    values[3, 2], usable[3, 2, 1] = 1, False
    found = estimate_crosstalk(values.astype(np.float32), COLOURS, usable)
    np.testing.assert_allclose(found, crosstalk, atol=3e-3)


@pytest.mark.parametrize("why", ["grey", "clipped", "dark", "no colours"])
def test_crosstalk_that_nothing_tells_of_is_none(why):
    rho = np.random.default_rng(0).uniform(0.1, 0.9, (40, 1, 3))
    levels = np.repeat(np.linspace(0, 1, 5)[:, None], 3, axis=1) if why == "grey" else COLOURS
    crosstalk = np.ones((3, 3)) / 3 if why == "no colours" else np.eye(3)
    values = np.zeros((40, 5, 3)) if why == "dark" else (rho * levels) @ crosstalk.T
    usable = np.full(values.shape, why != "clipped")
    found = estimate_crosstalk(values.astype(np.float32), levels.astype(np.float32), usable)
    np.testing.assert_array_equal(found, np.eye(3))
