"""Measurements in units of T and back: their form, S and rho once more, the error to expect."""

import numpy as np
import pytest

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.normalise import (
    Measurements,
    expected_error,
    normalise,
    refit_photometry,
)

NOISE = NoiseModel(4e-6, 5e-5)


@pytest.fixture
def photometry():
    """Two pixels; the third channel of the first sees nothing of the monitor."""
    S = np.full((2, 3), 0.1, np.float32)
    rho = np.array([[0.5, 0.8, 0.001], [0.4, 0.4, 0.4]], np.float32)
    return Photometry(S, rho, NOISE.variance(S) / 8, NOISE.variance(S + rho) / 8)


def test_normalise_gives_the_signed_form_and_its_variance(photometry):
    measurements = np.array([[[0.1, 0.9, 0.1], [0.6, 0.5, 0.1]], [[0.3] * 3] * 2], np.float32)
    value, variance = normalise(PatternLight.of(measurements), photometry, NOISE, 3.0)
    np.testing.assert_allclose(value[0], [[-1, 1, -1, 1], [1, 0, -1, 1], [0, 0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(value[1], [[0, 0, -1, 1]] * 3, atol=1e-6)
    seen = NOISE.variance(np.array([0.1, 0.6], np.float32))
    ends = [photometry.black_variance[0, 0], photometry.white_variance[0, 0]]
    np.testing.assert_allclose(variance[0, 0], 4 * np.append(seen, ends) / 0.5**2, rtol=1e-6)
    assert (variance[0, 2] == np.inf).all()
    assert (value.dtype, variance.dtype) == (np.float32, np.float32)


def test_unusable_measurements_have_infinite_variance(photometry):
    measurements = np.full((2, 4, 3), 0.3, np.float32)
    measurements[1, :2, 0] = np.nan, np.inf
    usable = np.ones(measurements.shape, bool)
    usable[1, 2, 0] = False
    worth = np.ones(measurements.shape, np.float32)
    worth[:, 3] = 4
    value, variance = normalise(PatternLight(measurements, usable, worth), photometry, NOISE, 3.0)
    assert np.isinf(variance[1, 0]).tolist() == [True, True, True, False, False, False]
    assert (value[1, 0, :3] == 0).all()
    assert np.isfinite(variance[1, 1:]).all()
    # four frames are four times as good
    np.testing.assert_allclose(variance[1, 1, 3], variance[1, 1, 0] / 4, rtol=1e-6)


def test_light_of_other_pixels_are_refused(photometry):
    with pytest.raises(ValueError, match="light must be"):
        normalise(
            PatternLight.of(np.zeros((len(photometry.S) + 1, 8, 3), np.float32)), photometry, NOISE, 3.0
        )


def test_refit_is_weighted_least_squares_in_camera_values(photometry):
    # known too badly to hold the fit back
    photometry = photometry._replace(
        black_variance=np.full((2, 3), 4e-4), white_variance=np.full((2, 3), 4e-4)
    )
    rng = np.random.default_rng(0)
    m, kappa = 30, np.zeros((2, 3))
    kappa[1, 1] = 0.05
    response = np.concatenate([rng.uniform(-1, 1, (2, 3, m)), np.tile([-1.0, 1.0], (2, 3, 1))], axis=2)
    response = response.astype(np.float32)
    light = (1 + response[:, :, :m].transpose(0, 2, 1)) / 2
    measurements = 0.01 + photometry.S[:, None] + 0.97 * photometry.rho[:, None] * light
    measurements += rng.normal(0, 0.01, measurements.shape)
    measurements[1, 3] = np.nan
    measured = normalise(PatternLight.of(measurements.astype(np.float32)), photometry, NOISE, 3.0)
    fit = refit_photometry(photometry, measured, response, kappa)
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


def test_refit_without_information_keeps_the_photometry(photometry):
    unknown = Measurements(np.zeros((2, 3, 5), np.float32), np.full((2, 3, 5), np.inf, np.float32))
    flat = Measurements(np.full((2, 3, 5), 0.3, np.float32), np.ones((2, 3, 5), np.float32))
    for measured in (unknown, flat):
        fit = refit_photometry(photometry, measured, np.zeros((2, 3, 5), np.float32), np.zeros((2, 3)))
        np.testing.assert_array_equal(fit.S, photometry.S)
        np.testing.assert_array_equal(fit.rho, photometry.rho)


def test_refit_ignores_overconfident_transport(photometry):
    # one cell is predicted, but the light comes from two: half of the patterns are grey
    response = np.where(np.arange(24) % 2, 1, -1) * np.ones((2, 3, 1))
    value = np.where(np.arange(24) % 4 < 2, response, 0)
    ends = np.tile([-1.0, 1.0], (2, 3, 1))
    measured = Measurements(
        np.concatenate([value, ends], axis=2).astype(np.float32), np.full((2, 3, 26), 1e-4, np.float32)
    )
    response = np.concatenate([response, ends], axis=2).astype(np.float32)
    fit = refit_photometry(photometry, measured, response, np.ones((2, 3)))
    black, white = (
        3 * np.sqrt(variance) for variance in (photometry.black_variance, photometry.white_variance)
    )
    assert (np.abs(fit.S - photometry.S) <= black).all()
    assert (np.abs(fit.rho - photometry.rho) <= black + white).all()


def test_the_error_to_expect_is_the_misfits_in_camera_units(photometry):
    variance = np.full((2, 3, 6), 1e-3, np.float32)
    variance[1, 2] = np.inf
    measured = Measurements(np.zeros((2, 3, 6), np.float32), variance)
    misfit = np.array([[0.04, 0.01, 0.02], [-0.1, 0.0, 0.0]])
    found = expected_error(photometry, measured, misfit)
    noise = 1e-3 / 6
    squares = photometry.rho.astype(float) ** 2 / 4 * [[0.04, 0.01, 0.02], [noise, noise, 0]]
    np.testing.assert_allclose(found, np.sqrt(squares.mean(axis=1)), rtol=1e-5)
    assert found.dtype == np.float32
    variance[:] = np.inf
    assert (expected_error(photometry, measured, misfit) == np.inf).all()
