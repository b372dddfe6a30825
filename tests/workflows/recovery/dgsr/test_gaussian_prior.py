"""The Gaussian prior: what it does to a recovery."""

import numpy as np
import pytest

from workflows.recovery.dgsr import recover as dgsr
from workflows.recovery.dgsr.options import Constants, DgsrOptions

COLUMNS, ROWS = 32, 24
COLUMN = np.arange(ROWS * COLUMNS) % COLUMNS


@pytest.fixture
def lobes(gaussian):
    """Pixels of one to three oriented Gaussians, a few cells wide."""

    def of(n, seed):
        rng = np.random.default_rng(seed)
        out = np.zeros((n, 3, ROWS * COLUMNS))
        for p in range(n):
            for weight in rng.dirichlet(np.full(1 + p % 3, 5.0)):
                x, y = rng.uniform(6, COLUMNS - 6), rng.uniform(6, ROWS - 6)
                shape = rng.uniform(1, 2.5), rng.uniform(0.6, 1), rng.uniform(0, np.pi)
                out[p] += weight * gaussian(COLUMNS, ROWS, x, y, *shape)[0]
        return out

    return of


def rows_of(transport):
    out = np.zeros((transport.count.size, ROWS * COLUMNS))
    out[np.repeat(np.arange(len(out)), transport.count.ravel()), transport.cell] = transport.weight
    return out.reshape(*transport.count.shape, -1)


def errors(found, truth):
    """Squared error of composites over random light, of which neighbouring cells share some."""
    light = np.random.default_rng(9).random((ROWS // 2, COLUMNS // 2, 50)).repeat(2, 0).repeat(2, 1)
    return ((rows_of(found) - truth) @ light.reshape(ROWS * COLUMNS, -1)) ** 2


def test_the_prior_cuts_the_error_of_lobes_from_few_measurements(sensing_of, observe, lobes):
    truth = lobes(12, 1)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 3)
    light, photometry, noise = observe(sensing, truth)
    plain = errors(dgsr.recover(light, photometry, sensing, noise, DgsrOptions(prior="none")), truth)
    filtered = errors(dgsr.recover(light, photometry, sensing, noise), truth)
    assert filtered.mean() < 0.5 * plain.mean()


def test_the_prior_leaves_a_t_of_few_cells_alone(sensing_of, observe):
    truth = np.zeros((1, 3, ROWS * COLUMNS))
    truth[:, :, [70, 400, 640, 705]] = [0.4, 0.3, 0.2, 0.1]  # more than there may be clusters
    sensing = sensing_of([(8, 6, 40), (COLUMNS, ROWS, 120)], 4)
    light, photometry, noise = observe(sensing, truth)
    found = rows_of(dgsr.recover(light, photometry, sensing, noise))
    assert np.abs(found - truth).sum(2).max() < 0.1


def test_what_fits_no_gaussian_is_taken_out(sensing_of, observe, lobes):
    truth = lobes(6, 2)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 5)
    light, photometry, noise = observe(sensing, truth)

    def cells(reach):
        options = DgsrOptions(constants=Constants(reach=reach))
        return (rows_of(dgsr.recover(light, photometry, sensing, noise, options)) > 0).sum()

    assert cells(2.0) < 0.7 * cells(4.0)


def test_one_cluster_is_all_there_may_be(sensing_of, observe, lobes):
    truth = lobes(3, 1)[1:2]  # two lobes
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 3)
    light, photometry, noise = observe(sensing, truth)

    def error(clusters):
        options = DgsrOptions(constants=Constants(clusters=clusters))
        return errors(dgsr.recover(light, photometry, sensing, noise, options), truth).mean()

    assert error(2) < 0.5 * error(1)


@pytest.mark.parametrize("prior", ["gaussian", "none"])
@pytest.mark.parametrize("channels", ["apart", "joint"])
@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("levels", ["hierarchical", "direct"])
def test_bad_input_gives_finite_rows(spoil, sensing_of, observe, prior, channels, levels, colours, lobes):
    truth = lobes(12, 7)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 40)], 6, channels=colours)
    light, photometry, noise = observe(sensing, truth)
    light, photometry = spoil(light, photometry, -1e30)
    options = DgsrOptions(prior, levels, channels, Constants(least_contrast=0.0))
    found = dgsr.recover(light, photometry, sensing, noise, options)
    assert np.isfinite(found.weight).all()
    assert (found.count[[1, 9, 10]] == 0).all()
    assert found.count[5, 1] == 0
    assert (found.count[5, [0, 2]] > 0).all()
    clean = dgsr.recover(*observe(sensing, truth)[:2], sensing, noise, options)
    np.testing.assert_allclose(rows_of(found)[2:4] @ COLUMN, rows_of(clean)[2:4] @ COLUMN, atol=1.5)


@pytest.mark.parametrize("prior", ["gaussian", "none"])
@pytest.mark.parametrize("bands", [[(32, 24, 1)], [(8, 6, 1), (32, 24, 2)], [(1, 1, 2), (32, 24, 3)]])
def test_a_program_too_small_gives_finite_rows(sensing_of, observe, prior, bands, lobes):
    truth = lobes(3, 8)
    sensing = sensing_of(bands, 2)
    light, photometry, noise = observe(sensing, truth)
    found = dgsr.recover(light, photometry, sensing, noise, DgsrOptions(prior=prior))
    assert np.isfinite(found.weight).all()


@pytest.mark.parametrize("light", [0.0, 1.0])
@pytest.mark.parametrize("prior", ["gaussian", "none"])
def test_patterns_that_are_all_the_same(sensing_of, observe, prior, light, lobes):
    sensing = sensing_of([(8, 6, 4), (COLUMNS, ROWS, 20)], 2)
    for level in sensing.levels:
        level.light[:] = light
    light, photometry, noise = observe(sensing, lobes(3, 8))
    found = dgsr.recover(light, photometry, sensing, noise, DgsrOptions(prior=prior))
    assert np.isfinite(found.weight).all()


def test_joint_channels_share_a_t_and_use_every_measurement(sensing_of, observe, lobes):
    truth = lobes(8, 4)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 40)], 8, channels=3)
    light, photometry, noise = observe(sensing, truth, rho=[0.9, 0.3, 0.5])
    joint = dgsr.recover(light, photometry, sensing, noise, DgsrOptions(channels="joint"))
    np.testing.assert_array_equal(rows_of(joint)[:, 0], rows_of(joint)[:, 2])
    apart = dgsr.recover(light, photometry, sensing, noise)
    assert errors(joint, truth).mean() < 0.7 * errors(apart, truth).mean()


def test_what_the_camera_clipped_is_left_out(sensing_of, observe, lobes):
    truth = lobes(6, 4)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 9)
    light, photometry, noise = observe(sensing, truth)
    usable = light.usable.copy()
    usable[:, 5::6] = False
    clean = errors(dgsr.recover(light, photometry, sensing, noise), truth).mean()
    light.values[~usable] = 1
    kept = errors(dgsr.recover(light, photometry, sensing, noise), truth).mean()
    left_out = errors(dgsr.recover(light._replace(usable=usable), photometry, sensing, noise), truth).mean()
    assert left_out < 3 * clean < kept
