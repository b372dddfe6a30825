"""The Gaussian prior: clusters, masses on cells, the filtered T, and what it does to a recovery."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from workflows.recovery import dgsr
from workflows.recovery.gaussian import CELL_VARIANCE, PARAMETERS, add_moments, merge_clusters, spread

COLUMNS, ROWS = 32, 24
COLUMN = np.arange(ROWS * COLUMNS) % COLUMNS


def moments_of(weight, x, y, major, minor, angle):
    """Raw moments of an oriented Gaussian seen through cells."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    (xx, xy), (_, yy) = turn @ np.diag([major**2, minor**2]) @ turn.T + CELL_VARIANCE * np.eye(2)
    return weight * np.array([1, x, y, xx + x * x, xy + x * y, yy + y * y])


def exact(x, y, major, minor, angle, fine=8):
    """An oriented Gaussian's mass on each cell, summed over a finer grid."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    v, u = (np.mgrid[: ROWS * fine, : COLUMNS * fine] + 0.5) / fine
    density = multivariate_normal([x, y], turn @ np.diag([major**2, minor**2]) @ turn.T)
    dense = density.pdf(np.stack([u, v], -1)) / fine**2
    return dense.reshape(ROWS, fine, COLUMNS, fine).sum((1, 3)).ravel()


def dense_of(cell, mass):
    out = np.zeros(ROWS * COLUMNS)
    out[cell] = mass
    return out


def raw(cells):
    """One cluster a cell, from (column, row, weight)."""
    moments = np.zeros((len(cells), PARAMETERS))
    for row, (x, y, weight) in zip(moments, cells, strict=True):
        add_moments(row, y * COLUMNS + x, COLUMNS, weight)
    return moments


@pytest.mark.parametrize(
    "shape", [(17.3, 9.6, 3.0, 0.6, 0.5), (12.0, 12.5, 0.5, 0.4, 2.0), (20.1, 14.9, 2.0, 0.4, np.pi / 4)]
)
def test_mass_is_the_integral_over_each_cell(shape):
    field = np.zeros((3, ROWS, COLUMNS), np.float32)
    cell, mass = spread(moments_of(1.0, *shape)[None], COLUMNS, 6.0, field)
    assert (np.diff(cell) > 0).all()
    assert np.abs(dense_of(cell, mass[0]) - exact(*shape)).sum() < 0.01
    assert (field == 0).all()


def test_masses_keep_their_weights_and_end_at_the_reach():
    field = np.zeros((2, ROWS, COLUMNS), np.float32)
    moments = np.stack([moments_of(0.6, 6, 6, 1.5, 1, 0.3), moments_of(0.2, 25, 18, 1, 1, 0)])
    cell, mass = spread(moments, COLUMNS, 3.0, field)
    np.testing.assert_allclose(mass.sum(1), [0.75, 0.25], atol=0.005)
    x, y = cell % COLUMNS + 0.5, cell // COLUMNS + 0.5
    assert np.hypot(x - 25, y - 18)[mass[1] > 0].max() < 3 * np.sqrt(2) + 1
    assert np.hypot(x - 25, y - 18)[mass[0] > 0].min() > 10


def test_a_gaussian_past_the_edge_has_all_its_mass_on_the_monitor():
    field = np.zeros((1, ROWS, COLUMNS), np.float32)
    cell, mass = spread(moments_of(1.0, 0.4, 23.8, 2, 1, 1.0)[None], COLUMNS, 3.0, field)
    assert (cell >= 0).all()
    assert (cell < ROWS * COLUMNS).all()
    assert mass.sum() == pytest.approx(1, abs=1e-5)


def test_one_cell_is_no_narrower_than_a_cell():
    field = np.zeros((1, ROWS, COLUMNS), np.float32)
    cell, mass = spread(raw([(7, 5, 1.0)]), COLUMNS, 3.0, field)
    expected = exact(7.5, 5.5, CELL_VARIANCE**0.5, CELL_VARIANCE**0.5, 0.0, fine=64)
    assert np.abs(dense_of(cell, mass[0]) - expected).sum() < 0.01


def test_clusters_are_what_lies_together():
    left, right = [(3, 4, 0.2), (4, 4, 0.3), (6, 5, 0.1)], [(25, 20, 0.1), (27, 19, 0.3)]
    moments = raw([left[0], right[0], left[1], right[1], left[2]])
    assert merge_clusters(moments, 5, 2) == 2
    found = moments[:2][np.argsort(moments[:2, 1] / moments[:2, 0])]
    np.testing.assert_allclose(found, [raw(left).sum(0), raw(right).sum(0)])


def test_fewer_clusters_than_allowed_stay():
    moments = raw([(3, 4, 0.2), (4, 4, 0.3)])
    assert merge_clusters(moments, 2, 3) == 2
    np.testing.assert_array_equal(moments, raw([(3, 4, 0.2), (4, 4, 0.3)]))


def lobes(n, seed):
    """Pixels of one to three oriented Gaussians, a few cells wide."""
    rng = np.random.default_rng(seed)
    out = np.zeros((n, ROWS * COLUMNS))
    for p in range(n):
        for weight in rng.dirichlet(np.full(1 + p % 3, 5.0)):
            x, y = rng.uniform(6, COLUMNS - 6), rng.uniform(6, ROWS - 6)
            out[p] += weight * exact(x, y, rng.uniform(1, 2.5), rng.uniform(0.6, 1), rng.uniform(0, np.pi), 4)
    return np.repeat(out[:, None], 3, axis=1) / out.sum(1)[:, None, None]


def rows_of(transport):
    out = np.zeros((transport.count.size, ROWS * COLUMNS))
    out[np.repeat(np.arange(len(out)), transport.count.ravel()), transport.cell] = transport.weight
    return out.reshape(*transport.count.shape, -1)


def errors(found, truth):
    """Squared error of composites over random light, of which neighbouring cells share some."""
    light = np.random.default_rng(9).random((ROWS // 2, COLUMNS // 2, 50)).repeat(2, 0).repeat(2, 1)
    return ((rows_of(found) - truth) @ light.reshape(ROWS * COLUMNS, -1)) ** 2


def test_the_prior_cuts_the_error_of_lobes_from_few_measurements(sensing_of, observe):
    truth = lobes(12, 1)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 3)
    measurements, photometry, noise = observe(sensing, truth)
    plain = errors(dgsr.recover(measurements, photometry, sensing, noise, prior="none"), truth)
    filtered = errors(dgsr.recover(measurements, photometry, sensing, noise), truth)
    assert filtered.mean() < 0.5 * plain.mean()


def test_the_prior_leaves_a_t_of_few_cells_alone(sensing_of, observe):
    truth = np.zeros((1, 3, ROWS * COLUMNS))
    truth[:, :, [70, 400, 640, 705]] = [0.4, 0.3, 0.2, 0.1]  # more than there may be clusters
    sensing = sensing_of([(8, 6, 40), (COLUMNS, ROWS, 120)], 4)
    scene = observe(sensing, truth)
    found = rows_of(dgsr.recover(scene[0], scene[1], sensing, scene[2]))
    assert np.abs(found - truth).sum(2).max() < 0.1


def test_what_fits_no_gaussian_is_taken_out(sensing_of, observe):
    truth = lobes(6, 2)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 5)
    scene = observe(sensing, truth)
    near = rows_of(dgsr.recover(scene[0], scene[1], sensing, scene[2], reach=2.0)) > 0
    far = rows_of(dgsr.recover(scene[0], scene[1], sensing, scene[2], reach=4.0)) > 0
    assert near.sum() < 0.7 * far.sum()


def test_one_cluster_is_all_there_may_be(sensing_of, observe):
    truth = lobes(3, 1)[1:2]  # two lobes
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 3)
    measurements, photometry, noise = observe(sensing, truth)

    def error(clusters):
        return errors(dgsr.recover(measurements, photometry, sensing, noise, clusters=clusters), truth).mean()

    assert error(2) < 0.5 * error(1)


@pytest.mark.parametrize("prior", ["gaussian", "none"])
@pytest.mark.parametrize("channels", ["apart", "joint"])
@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("levels", ["hierarchical", "direct"])
def test_bad_input_gives_finite_rows(sensing_of, observe, prior, channels, levels, colours):
    truth = lobes(12, 7)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 40)], 6, channels=colours)
    measurements, photometry, noise = observe(sensing, truth)
    S, rho = photometry.S.copy(), photometry.rho.copy()
    measurements[0, 3:40] = np.nan
    measurements[1] = np.nan
    measurements[2, 5] = np.inf
    measurements[3, 7] = -1e30
    measurements[4] = 1  # saturated
    measurements[5, :, 1] = np.nan
    measurements[6] = 0
    measurements[7] = np.random.default_rng(0).random(measurements[7].shape)
    rho[8] = 1e-12
    S[9], rho[10] = np.nan, np.nan
    S[11] = 50
    options = {"prior": prior, "channels": channels, "levels": levels, "least_contrast": 0.0}
    found = dgsr.recover(measurements, replace(photometry, S=S, rho=rho), sensing, noise, **options)
    assert np.isfinite(found.weight).all()
    assert (found.count[[1, 9, 10]] == 0).all()
    assert found.count[5, 1] == 0
    assert (found.count[5, [0, 2]] > 0).all()
    clean = dgsr.recover(*observe(sensing, truth)[:2], sensing, noise, **options)
    np.testing.assert_allclose(rows_of(found)[2:4] @ COLUMN, rows_of(clean)[2:4] @ COLUMN, atol=1.5)


@pytest.mark.parametrize("prior", ["gaussian", "none"])
@pytest.mark.parametrize("bands", [[(32, 24, 1)], [(8, 6, 1), (32, 24, 2)], [(1, 1, 2), (32, 24, 3)]])
def test_a_program_too_small_gives_finite_rows(sensing_of, observe, prior, bands):
    truth = lobes(3, 8)
    sensing = sensing_of(bands, 2)
    measurements, photometry, noise = observe(sensing, truth)
    found = dgsr.recover(measurements, photometry, sensing, noise, prior=prior)
    assert np.isfinite(found.weight).all()


@pytest.mark.parametrize("light", [0.0, 1.0])
@pytest.mark.parametrize("prior", ["gaussian", "none"])
def test_patterns_that_are_all_the_same(sensing_of, observe, prior, light):
    sensing = sensing_of([(8, 6, 4), (COLUMNS, ROWS, 20)], 2)
    for level in sensing.levels:
        level.light[:] = light
    measurements, photometry, noise = observe(sensing, lobes(3, 8))
    found = dgsr.recover(measurements, photometry, sensing, noise, prior=prior)
    assert np.isfinite(found.weight).all()


def test_joint_channels_share_a_t_and_use_every_measurement(sensing_of, observe):
    truth = lobes(8, 4)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 40)], 8, channels=3)
    measurements, photometry, noise = observe(sensing, truth, rho=[0.9, 0.3, 0.5])
    joint = dgsr.recover(measurements, photometry, sensing, noise, channels="joint")
    np.testing.assert_array_equal(rows_of(joint)[:, 0], rows_of(joint)[:, 2])
    apart = dgsr.recover(measurements, photometry, sensing, noise)
    assert errors(joint, truth).mean() < 0.7 * errors(apart, truth).mean()


def test_what_the_camera_clipped_is_left_out(sensing_of, observe):
    truth = lobes(6, 4)
    sensing = sensing_of([(8, 6, 24), (COLUMNS, ROWS, 60)], 9)
    measurements, photometry, noise = observe(sensing, truth)
    usable = np.ones(measurements.shape, bool)
    usable[:, 5::6] = False
    clean = errors(dgsr.recover(measurements, photometry, sensing, noise), truth).mean()
    measurements[~usable] = 1
    kept = errors(dgsr.recover(measurements, photometry, sensing, noise), truth).mean()
    left_out = errors(dgsr.recover(measurements, photometry, sensing, noise, usable), truth).mean()
    assert left_out < 3 * clean < kept
