"""What NN-DGSR owes, whatever its options: known scenes, any batch, dark channels, patterns of three colours."""

from functools import partial

import numpy as np
import pytest

from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.dgsr import recover as dgsr
from workflows.recovery.dgsr.options import DgsrOptions
from workflows.recovery.normalise import Conditions
from workflows.recovery.sensing import Sensing

METHODS = {
    "dgsr": dgsr.recover,
    "dgsr-plain": partial(dgsr.recover, options=DgsrOptions(prior="none")),
    "dgsr-direct": partial(dgsr.recover, options=DgsrOptions(levels="direct")),
    "dgsr-joint": partial(dgsr.recover, options=DgsrOptions(channels="joint")),
    "dgsr-plain-direct-joint": partial(dgsr.recover, options=DgsrOptions("none", "direct", "joint")),
}
BANDS = [(8, 6, 24), (32, 24, 120)]
COLUMNS, ROWS = 32, 24


@pytest.fixture(params=METHODS.values(), ids=METHODS)
def recover(request):
    return request.param


@pytest.fixture(params=[name for name in METHODS if "joint" not in name])
def recover_apart(request):
    """A method for which the channels may differ."""
    return METHODS[request.param]


def dense(transport):
    assert (transport.columns, transport.rows) == (COLUMNS, ROWS)
    out = np.zeros((*transport.count.shape, ROWS * COLUMNS))
    row = np.repeat(np.arange(out.shape[0] * 3), transport.count.ravel())
    out.reshape(-1, out.shape[2])[row, transport.cell] = transport.weight
    return out


def cells(*weights):
    """One pixel's T from (column, row, weight), the same in all channels."""
    out = np.zeros((1, 3, ROWS, COLUMNS))
    for column, row, weight in weights:
        out[:, :, row, column] += weight
    return out.reshape(1, 3, -1)


def lobe(column, row, major, minor, angle):
    """An oriented Gaussian in units of cells; the centre of cell 0 is at 0.5."""
    y, x = np.mgrid[:ROWS, :COLUMNS] + 0.5
    u = (x - column) * np.cos(angle) + (y - row) * np.sin(angle)
    v = (y - row) * np.cos(angle) - (x - column) * np.sin(angle)
    grid = np.exp(-0.5 * ((u / major) ** 2 + (v / minor) ** 2))
    return np.repeat((grid / grid.sum()).reshape(1, 1, -1), 3, axis=1)


def mixture(n=24, seed=5):
    """Random pixels of one to three cells, each channel its own."""
    rng = np.random.default_rng(seed)
    out = np.zeros((n, 3, ROWS * COLUMNS))
    for p in range(n):
        for c in range(3):
            where = rng.choice(ROWS * COLUMNS, 1 + p % 3, replace=False)
            out[p, c, where] = rng.dirichlet(np.full(where.size, 5.0))
    return out


def test_one_cell(recover, sensing_of, observe):
    truth = cells((13, 7, 1.0))
    sensing = sensing_of(BANDS, 1)
    found = dense(recover(*args(observe(sensing, truth), sensing)))
    assert np.abs(found - truth).sum(2).max() < 0.05


def test_two_cells(recover, sensing_of, observe):
    truth = cells((3, 20, 0.7), (27, 4, 0.3))
    sensing = sensing_of(BANDS, 2)
    found = dense(recover(*args(observe(sensing, truth), sensing)))
    assert np.abs(found - truth).sum(2).max() < 0.08


def test_an_oriented_gaussian_between_cells(recover, sensing_of, observe):
    truth = lobe(17.0, 9.4, 1.8, 0.8, 0.6)
    sensing = sensing_of(BANDS, 3)
    found = dense(recover(*args(observe(sensing, truth), sensing)))
    assert np.abs(found - truth).sum(2).max() < 0.3
    x = np.arange(COLUMNS * ROWS) % COLUMNS + 0.5
    y = np.arange(COLUMNS * ROWS) // COLUMNS + 0.5
    np.testing.assert_allclose(found @ x, 17.0, atol=0.15)
    np.testing.assert_allclose(found @ y, 9.4, atol=0.15)


@pytest.mark.parametrize("colours", [1, 3])
def test_channels_that_differ(recover_apart, sensing_of, observe, colours):
    truth = mixture()
    sensing = sensing_of(BANDS, 4, channels=colours)
    error = np.abs(dense(recover_apart(*args(observe(sensing, truth), sensing))) - truth).sum(2)
    assert np.median(error) < 0.1


def test_patterns_of_three_colours(recover, sensing_of, observe):
    truth = cells((5, 5, 0.6), (22, 15, 0.4))
    sensing = sensing_of(BANDS, 5, channels=3)
    found = dense(recover(*args(observe(sensing, truth), sensing)))
    assert np.abs(found - truth).sum(2).max() < 0.1


@pytest.mark.parametrize("colours", [1, 3])
def test_result_does_not_depend_on_the_batch(recover, sensing_of, observe, colours):
    truth = np.concatenate([mixture(), lobe(12.0, 12.5, 2.5, 1.2, 0.3)])
    sensing = sensing_of(BANDS, 6, channels=colours)
    light, photometry, noise = observe(sensing, truth)
    whole = recover(light, photometry, sensing, noise)
    order = np.random.default_rng(0).permutation(len(truth))
    for part in (order, order[:7], order[7:8]):
        alone = recover(light.of_pixels(part), photometry.of_pixels(part), sensing, noise)
        np.testing.assert_array_equal(alone.count, whole.count[part])
        np.testing.assert_array_equal(dense(alone), dense(whole)[part])


def test_dark_channels_get_empty_rows(recover, sensing_of, observe):
    truth = np.concatenate([cells((13, 7, 1.0)), cells((13, 7, 1.0))])
    sensing = sensing_of(BANDS, 7)
    scene = observe(sensing, truth, rho=[[0.7, 0.002, 0.0], [0.0, 0.0, 0.0]])
    found = recover(*args(scene, sensing))
    assert (found.count[0] > 0).tolist() == [True, False, False]
    assert (found.count[1] == 0).all()
    assert np.abs(dense(found)[0, 0] - truth[0, 0]).sum() < 0.05


@pytest.mark.parametrize("colours", [1, 3])
def test_grey_camera_counts_once(recover, sensing_of, observe, colours):
    sensing = sensing_of(BANDS, 12, channels=colours)
    light, photometry, noise = observe(sensing, mixture(6))
    grey = np.repeat(light.values[..., :1], 3, axis=2)
    found = recover(PatternLight.of(grey), photometry, sensing, noise, conditions=Conditions(grey=True))
    usable = np.zeros(grey.shape, bool)
    usable[..., 0] = True
    alone = dense(dgsr.recover(PatternLight.of(grey, usable), photometry, sensing, noise))
    for c in range(3):
        np.testing.assert_array_equal(dense(found)[:, c], dense(found)[:, 0])
    assert np.abs(dense(found)[:, 0] - mixture(6)[:, 0]).sum(1).mean() < 0.3
    assert (alone[:, 1:] == 0).all()
    if recover is dgsr.recover:
        np.testing.assert_allclose(dense(found)[:, 0], alone[:, 0], atol=1e-4)


def test_error_of_the_model_is_left_unexplained(sensing_of, observe):
    truth = np.concatenate([lobe(x + 0.5, 12.4, 2.5, 1.2, 0.3) for x in range(6, 26)])
    sensing = sensing_of(BANDS, 13)
    light, photometry, noise = observe(sensing, truth)
    wrong = 0.06 * np.random.default_rng(0).standard_normal(light.values.shape[1])[:, np.newaxis]
    seen = PatternLight.of((light.values + wrong * photometry.rho[:, np.newaxis]).astype(np.float32))
    off = [
        np.abs(dense(dgsr.recover(seen, photometry, sensing, noise, conditions=c)) - truth).sum()
        for c in (Conditions(model_error=0.06), Conditions())
    ]
    assert off[0] < 0.9 * off[1]


def test_rows_are_clean(recover, sensing_of, observe):
    sensing = sensing_of(BANDS, 8)
    found = recover(*args(observe(sensing, mixture(6)), sensing))
    np.testing.assert_allclose(dense(found).sum(2), 1, atol=1e-6)
    assert found.weight.min() >= 0.99e-4
    assert found.cell.dtype == np.uint32


@pytest.mark.parametrize("colours", [1, 3])
def test_no_pixels(recover, sensing_of, observe, colours):
    sensing = sensing_of(BANDS, 9, channels=colours)
    found = recover(*args(observe(sensing, mixture(0)), sensing))
    assert found.count.shape == (0, 3)


def test_one_level_serves(recover, sensing_of, observe):
    truth = cells((13, 7, 1.0))
    sensing = Sensing(sensing_of([(COLUMNS, ROWS, 60)], 10).levels[-1:])
    found = dense(recover(*args(observe(sensing, truth), sensing)))
    assert np.abs(found - truth).sum(2).max() < 0.1


def test_light_of_another_number_of_pixels_or_patterns_are_refused(recover, sensing_of, observe):
    sensing = sensing_of(BANDS, 11)
    light, photometry, noise = observe(sensing, mixture(3))
    with pytest.raises(ValueError, match="light must be"):
        recover(light.of_pixels(slice(2)), photometry, sensing, noise)
    with pytest.raises(ValueError, match="patterns"):
        recover(light.of_patterns(np.arange(1, light.values.shape[1])), photometry, sensing, noise)


def args(scene, sensing):
    light, photometry, noise = scene
    return light, photometry, sensing, noise
