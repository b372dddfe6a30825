"""The default recovery: known scenes, channels that differ or do not, S and rho, any batch, and bad input."""

from dataclasses import replace

import numpy as np
import pytest

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import fit_photometry
from workflows.recovery.lobes import recover as lobes
from workflows.recovery.lobes.options import FINE, LobesOptions
from workflows.recovery.sensing import Patterns

COLUMNS, ROWS = 64, 48
BANDS = [(8, 6, 20), (16, 12, 20), (32, 24, 20), (COLUMNS, ROWS, 20)]


@pytest.fixture(scope="module")
def patterns(patterns_of):
    return patterns_of(BANDS, 1)


@pytest.fixture(scope="module")
def coloured(patterns_of):
    return patterns_of(BANDS, 2, channels=3)


@pytest.fixture(scope="module")
def truth(gaussian):
    """(n, 3, cells) Gaussians of the given shapes, a pixel each."""
    return lambda *shapes: np.concatenate([gaussian(COLUMNS, ROWS, *shape) for shape in shapes])


@pytest.fixture(scope="module")
def varied(truth):
    """Pixels of one or two lobes, every third of them with channels that differ."""
    rng = np.random.default_rng(5)
    pixels = []
    for p in range(12):
        shapes = np.column_stack([rng.uniform((10, 10, 1, 1, 0), (54, 38, 4, 2, 3), (3, 5))])
        T = truth(*shapes)
        row = 0.6 * T[0] + 0.4 * T[1] if p % 2 else T[0]
        pixels.append(T[[0, 1, 2], 0] if p % 3 == 2 else row)
    return np.stack(pixels)


def dense(patterns, transport):
    """(n, 3, cells) what the rows see of each cell of the first grid."""
    pyramid = patterns.pyramid
    cells = pyramid.light(np.eye(ROWS * COLUMNS, dtype=np.float32).reshape(ROWS, COLUMNS, -1))
    row = np.repeat(np.arange(transport.count.size), transport.count.ravel())
    out = np.zeros((transport.count.size, pyramid.nodes))
    out[row, transport.cell] = transport.weight
    out = (out @ cells).reshape(-1, 3, ROWS * COLUMNS)
    out[transport.shared, 1:] = out[transport.shared, :1]
    return out


def moments(T):
    """Centre and covariance (xx, xy, yy) of rows of cells."""
    y, x = np.mgrid[:ROWS, :COLUMNS].reshape(2, -1) + 0.5
    cx, cy = T @ x, T @ y
    return np.stack([cx, cy, T @ x**2 - cx**2, T @ (x * y) - cx * cy, T @ y**2 - cy**2], axis=-1)


def recovered(patterns, scene, options=FINE, **given):
    light, photometry, noise = scene
    return lobes.recover(light, photometry, patterns, noise, options=options, **given)


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
@pytest.mark.parametrize(
    "shape",
    [
        pytest.param((30.0, 20.0, 0.7, 0.7), id="a small spot between cells"),
        pytest.param((25.3, 18.6, 3.0, 1.0, 0.6), id="oriented"),
        pytest.param((33.1, 24.8, 7.0, 5.0, 2.0), id="wide"),
        pytest.param((1.0, 30.0, 1.0, 1.0), id="at the edge"),
    ],
)
def test_one_lobe_is_found(request, colours, shape, truth, observe):
    shown, T = request.getfixturevalue(colours), truth(shape)
    T_found = dense(shown, recovered(shown, observe(shown, T)).transport)
    assert np.abs(T_found - T).sum(axis=2).max() < 0.35
    is_wide = shape[2] * shape[3]
    # a thousandth far away weighs much in a covariance
    T_found *= T > 1e-12
    T_found /= T_found.sum(axis=2, keepdims=True)
    np.testing.assert_allclose(moments(T_found)[..., :2], moments(T)[..., :2], atol=0.1 + 0.01 * is_wide)
    np.testing.assert_allclose(moments(T_found)[..., 2:], moments(T)[..., 2:], atol=0.4 + 0.1 * is_wide)


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
def test_two_lobes_are_found_with_their_shares(request, colours, truth, observe):
    shown = request.getfixturevalue(colours)
    one, two = truth((14.6, 30.2, 1.5, 1.0, 0.3)), truth((45.3, 16.7, 2.0, 1.5, 1.0))
    T = 0.65 * one + 0.35 * two
    T_found = dense(shown, recovered(shown, observe(shown, T)).transport)
    assert np.abs(T_found - T).sum(axis=2).max() < 0.3
    left = np.arange(COLUMNS * ROWS) % COLUMNS < 30
    np.testing.assert_allclose(T_found[..., left].sum(axis=2), 0.65, atol=0.03)
    for side, lobe in ((left, one), (~left, two)):
        part = T_found * side / (T_found * side).sum(axis=2, keepdims=True)
        np.testing.assert_allclose(moments(part)[..., :2], moments(lobe)[..., :2], atol=0.2)


def test_posterior_mean_finds_what_lobes_miss(patterns, observe):
    # half a disc is no Gaussian
    y, x = np.mgrid[:ROWS, :COLUMNS].reshape(2, -1) + 0.5
    rng, pixels = np.random.default_rng(0), []
    for _ in range(6):
        u, v, angle = rng.uniform((20, 15, 0), (44, 33, 6))
        side = (x - u) * np.cos(angle) + (y - v) * np.sin(angle) < 0
        half = side & ((x - u) ** 2 + (y - v) ** 2 < 100)
        pixels.append(np.tile(half / half.sum(), (3, 1)))
    T = np.stack(pixels)
    scene = observe(patterns, T)
    L = rng.integers(0, 2, (20, 6, 8)).repeat(8, axis=1).repeat(8, axis=2).reshape(20, -1)

    def error(passes):
        found = recovered(patterns, scene, LobesOptions(most_lobes=1, passes=passes)).transport
        return np.sqrt(np.mean(((dense(patterns, found) - T) @ L.T) ** 2))

    assert error(3) < 0.4 * error(0)


def test_lobes_that_miss_are_fitted_again(patterns, truth, observe):
    # a streak: a lobe that is turned a little is better wide than narrow, and small steps leave it so
    rng = np.random.default_rng(0)
    low, high = (20, 14, 5, 0.8, 0), (44, 34, 9, 1.2, 3)
    T = np.concatenate([truth(tuple(rng.uniform(low, high))) for _ in range(60)])
    scene = observe(patterns, T)

    def error(doubt):
        found = recovered(patterns, scene, LobesOptions(doubt=doubt, steps=4)).transport
        return np.mean((dense(patterns, found) - T) ** 2)

    assert error(0.01) < 0.8 * error(1.0)


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
def test_channels_that_differ_get_their_own_t(request, colours, truth, observe):
    shown = request.getfixturevalue(colours)
    # dispersed, far apart, and alike
    T = np.stack(
        [
            truth((20.0, 20.0, 1.5, 1), (21.5, 20.0, 1.5, 1), (23.0, 20.0, 1.5, 1))[:, 0],
            truth((15.0, 30.0, 1.5, 1), (45.0, 12.0, 3.0, 1), (30.0, 24.0, 1.0, 1))[:, 0],
            truth((40.3, 30.0, 2.0, 1))[0],
        ]
    )
    found = recovered(shown, observe(shown, T)).transport
    assert found.shared.tolist()[:2] == [False, False]
    assert (found.count[:2] > 0).all()
    T_found = dense(shown, found)
    assert np.abs(T_found - T).sum(axis=2).max() < 0.4
    np.testing.assert_allclose(moments(T_found)[..., :2], moments(T)[..., :2], atol=0.5)


def test_channels_that_differ_by_less_than_lobes_miss_get_their_own_t(coloured, truth, observe):
    """A bend of light, which no lobe resembles, dispersed by half a cell from channel to channel."""
    draws = np.random.default_rng(3).uniform((15, 12), (45, 34), (20, 2))

    def bend(x, y):
        around = np.linspace(0, 1.5 * np.pi, 12)
        spots = [truth((x + 5 * np.cos(a), y + 5 * np.sin(a), 0.5, 0.5))[0, 0] for a in around]
        return np.mean(spots, axis=0)

    T = np.stack([[bend(x + 0.5 * c, y) for c in range(3)] for x, y in draws])
    alike = np.repeat(T[:, :1], 3, axis=1)
    assert recovered(coloured, observe(coloured, T)).transport.shared.mean() < 0.3
    assert recovered(coloured, observe(coloured, alike)).transport.shared.mean() > 0.7


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
@pytest.mark.parametrize("shape", [(25.3, 18.6, 3.0, 1.0, 0.6), (33.1, 24.8, 7.0, 5.0, 2.0)])
def test_channels_that_agree_share_a_t(request, colours, shape, truth, observe):
    shown = request.getfixturevalue(colours)
    found = recovered(shown, observe(shown, np.repeat(truth(shape), 30, axis=0))).transport
    assert found.shared.mean() > 0.9
    np.testing.assert_array_equal((found.count > 0).sum(axis=1), np.where(found.shared, 1, 3))


def test_disagreement_decides_whether_channels_share_t(patterns, varied, observe):
    scene = observe(patterns, varied)
    assert not recovered(patterns, scene, LobesOptions(disagreement=0.0)).transport.shared.any()
    assert recovered(patterns, scene, LobesOptions(disagreement=1e6)).transport.shared.all()


def test_patterns_improve_s_and_rho(patterns, truth, observe):
    n, rng, noise = 40, np.random.default_rng(0), NoiseModel(4e-6, 5e-5)
    T = np.repeat(truth((25.3, 18.6, 3.0, 1.5, 0.6)), n, axis=0)
    light, exact, _ = observe(patterns, T)
    levels = np.repeat(np.linspace(0, 1, 4)[:, None], 3, axis=1).astype(np.float32)
    seen = exact.S[:, None] + exact.rho[:, None] * levels
    seen = (seen + np.sqrt(noise.variance(seen)) * rng.standard_normal(seen.shape)).astype(np.float32)
    alone = fit_photometry(PatternLight.of(seen), levels, noise)
    joint = recovered(patterns, (light, alone, noise)).photometry
    for name, least in (("S", 0.9), ("rho", 0.7)):
        before, after = (np.std(getattr(fit, name) - getattr(exact, name)) for fit in (alone, joint))
        assert after < least * before
    assert joint.S.dtype == joint.rho.dtype == np.float32


def test_the_error_to_expect_is_about_that_of_composites(patterns, varied, observe):
    light, photometry, noise = observe(patterns, varied)
    found = lobes.recover(light, photometry, patterns, noise)
    T, rng, squares = dense(patterns, found.transport), np.random.default_rng(0), []
    for size in (4, 8, 2):
        blocks = rng.integers(0, 2, (ROWS // size, COLUMNS // size))
        L = blocks.repeat(size, axis=0).repeat(size, axis=1).ravel()
        squares.append(((photometry.rho * ((T - varied) @ L)) ** 2).mean(axis=1))
    actual = np.sqrt(np.mean(squares))
    assert actual / 3 < np.sqrt(np.mean(found.error**2)) < 3 * actual


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
def test_any_batch_and_order_give_the_same_bytes(monkeypatch, request, colours, varied, observe):
    shown = request.getfixturevalue(colours)
    light, photometry, noise = observe(shown, varied)
    photometry.rho[4] = 0
    whole = lobes.recover(light, photometry, shown, noise)
    start = np.append(0, np.cumsum(whole.transport.count.sum(axis=1, dtype=int)))
    order = np.random.default_rng(0).permutation(len(varied))
    monkeypatch.setattr(lobes, "_BLOCK", 5)
    for part in (order, order[:7], order[7:8]):
        alone = lobes.recover(light.of_pixels(part), photometry.of_pixels(part), shown, noise)
        np.testing.assert_array_equal(alone.transport.count, whole.transport.count[part])
        np.testing.assert_array_equal(alone.transport.shared, whole.transport.shared[part])
        entries = np.concatenate([np.arange(start[p], start[p + 1]) for p in part])
        for name in ("cell", "weight"):
            expected = getattr(whole.transport, name)[entries]
            assert getattr(alone.transport, name).tobytes() == expected.tobytes()
        for name in ("S", "rho"):
            expected = getattr(whole.photometry, name)[part]
            assert getattr(alone.photometry, name).tobytes() == expected.tobytes()
        assert alone.error.tobytes() == whole.error[part].tobytes()


def test_rows_are_clean(patterns, varied, observe):
    found = recovered(patterns, observe(patterns, varied)).transport
    assert (found.columns, found.rows) == (COLUMNS, ROWS)
    lit = found.count[found.count > 0].astype(int)
    sums = np.add.reduceat(found.weight, np.append(0, np.cumsum(lit)[:-1]))
    np.testing.assert_allclose(sums, 1, atol=1e-5)
    assert found.weight.min() >= 0.99e-4
    assert found.cell.max() < patterns.pyramid.nodes
    rows = np.split(found.cell.astype(int), np.cumsum(lit)[:-1])
    assert all((np.diff(row) > 0).all() for row in rows)


@pytest.mark.parametrize("least", [0.0, 1e-3])
def test_least_weight_bounds_the_kept_weights(patterns, truth, observe, least):
    scene = observe(patterns, truth((33.1, 24.8, 12.0, 8.0)))
    options = LobesOptions(least_weight=least, fit_resolution=4.0, resolution=4.0)
    found = recovered(patterns, scene, options).transport
    assert found.weight.min() >= least
    assert found.weight.min() < max(1.2 * least, 1e-4)


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
def test_dark_channels_have_no_row(request, colours, truth, observe):
    shown, T = request.getfixturevalue(colours), truth(*[(25.3, 18.6, 3.0, 1.0, 0.6)] * 3)
    scene = observe(shown, T, rho=[[0.7, 0.002, 0.0], [0.0, 0.0, 0.0], [0.0, 0.7, 0.7]])
    found = recovered(shown, scene)
    assert (found.transport.count.sum(axis=1) > 0).tolist() == [True, False, True]
    assert np.isinf(found.error).tolist() == [False, True, False]
    T_found = dense(shown, found.transport)
    assert np.abs(T_found - T)[0, 0].sum() < 0.35
    assert np.abs(T_found - T)[2, 1:].sum(axis=1).max() < 0.35
    np.testing.assert_array_equal(found.photometry.S[1], scene[1].S[1])
    np.testing.assert_array_equal(found.photometry.rho[1], 0)
    assert found.photometry.rho[0, 1] == np.float32(0.002)


@pytest.mark.parametrize("n", [0, 2])
def test_without_light_there_are_no_rows(patterns, coloured, truth, observe, n):
    for shown in (patterns, coloured):
        T = truth((20, 20, 1, 1), (30, 20, 1, 1))[:n]
        found = recovered(shown, observe(shown, T, rho=0.0))
        assert found.transport.count.shape == (n, 3)
        assert found.transport.count.sum() == found.transport.cell.size == 0
        assert found.photometry.S.shape == found.photometry.rho.shape == (n, 3)


def test_what_was_not_measured_is_left_out(patterns, truth, observe):
    T = truth((25.3, 18.6, 2.0, 1.5, 0.6), (40.0, 30.0, 3.0, 1.5, 0.6))
    light, photometry, noise = observe(patterns, T)
    usable = light.usable.copy()
    usable[:, 3::5] = False
    clipped, missing = light.values.copy(), light.values.copy()
    clipped[~usable], missing[~usable] = 1, np.nan
    by_mask = lobes.recover(PatternLight.of(clipped, usable), photometry, patterns, noise)
    by_nan = lobes.recover(PatternLight.of(missing), photometry, patterns, noise)
    assert np.abs(dense(patterns, by_mask.transport) - T).sum(axis=2).max() < 0.4
    for one, other in zip(vars(by_mask.transport).values(), vars(by_nan.transport).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(by_mask.photometry.rho, by_nan.photometry.rho)
    believed = dense(patterns, lobes.recover(PatternLight.of(clipped), photometry, patterns, noise).transport)
    assert np.abs(believed - T).sum(axis=2).max() > 0.5


@pytest.mark.parametrize("colours", ["patterns", "coloured"])
def test_bad_input_gives_finite_rows(spoil, request, colours, varied, observe):
    shown = request.getfixturevalue(colours)
    light, photometry, noise = observe(shown, varied)
    light, photometry = spoil(light, photometry, -1e3)
    for least_contrast in (3.0, 0.0):
        options = LobesOptions(least_contrast=least_contrast)
        found = recovered(shown, (light, photometry, noise), options)
        assert np.isfinite(found.transport.weight).all()
        sane = [0, 2, 5]
        error = np.abs(dense(shown, found.transport) - varied).sum(axis=2)
        assert error[0].max() < 0.8
        assert error[2].max() < 0.8
        assert np.isfinite(found.photometry.S[sane]).all()
        assert np.isfinite(found.photometry.rho[sane]).all()


def test_patterns_shown_twice_or_all_alike_are_taken(patterns, truth, observe):
    twice = Patterns(patterns.pyramid, 1, np.tile(patterns.code, 2))
    T = truth((25.3, 18.6, 3.0, 1.0, 0.6))
    found = recovered(twice, observe(twice, T)).transport
    assert np.abs(dense(twice, found) - T).sum(axis=2).max() < 0.35
    same = Patterns(patterns.pyramid, 1, np.repeat(patterns.code[:, 5:6], 30, axis=1))
    found = recovered(same, observe(same, T)).transport
    assert np.isfinite(found.weight).all()
    assert (found.count[:, 0] > 0).all()


@pytest.mark.parametrize("light", [0, 128, 255])
def test_patterns_that_are_constant_give_finite_rows(patterns, truth, observe, light):
    flat = Patterns(patterns.pyramid, 1, np.full((patterns.pyramid.nodes, 10), light, np.uint8))
    found = recovered(flat, observe(flat, truth((25.3, 18.6, 3.0, 1.0)))).transport
    assert np.isfinite(found.weight).all()
    assert found.count[0, 0] > 0


@pytest.mark.parametrize("count", [1, 3])
def test_few_patterns_give_finite_rows(patterns_of, truth, observe, count):
    few = patterns_of([(COLUMNS, ROWS, count)], 3)
    T = truth((25.3, 18.6, 3.0, 1.0, 0.6), (1, 1, 1, 1))
    found = recovered(few, observe(few, T))
    assert np.isfinite(found.transport.weight).all()
    assert (found.transport.count.sum(axis=1) > 0).all()
    np.testing.assert_allclose(found.photometry.rho, 0.7, atol=0.02)


def test_a_pyramid_of_one_grid_suffices(patterns_of, gaussian, observe):
    small = patterns_of([(8, 6, 20), (16, 12, 40)], 4)
    assert len(small.pyramid.grids) == 1
    T = gaussian(16, 12, 7.3, 5.6, 1.0, 0.8, 0.4)
    found = recovered(small, observe(small, T)).transport
    weights = np.zeros(16 * 12)
    weights[found.cell] = found.weight
    assert np.abs(weights - T[0, 0]).sum() < 0.2


def test_grey_camera_counts_once(patterns, truth, observe):
    light, photometry, noise = observe(patterns, truth((25.3, 18.6, 3.0, 1.0), (40.1, 30.2, 1.0, 1.0)))
    grey = np.repeat(light.values[..., :1], 3, axis=2)
    found = lobes.recover(
        PatternLight.of(grey), photometry, patterns, noise, conditions=lobes.Conditions(grey=True)
    )
    assert found.transport.shared.all()
    for values in (found.photometry.S, found.photometry.rho):
        np.testing.assert_array_equal(values, np.repeat(values[:, :1], 3, axis=1))
    usable = np.zeros(grey.shape, bool)
    usable[..., 0] = True
    alone = lobes.recover(PatternLight.of(grey, usable), photometry, patterns, noise)
    np.testing.assert_array_equal(found.transport.weight, alone.transport.weight)


def test_error_of_the_model_is_left_unexplained(patterns, truth, observe):
    T = truth(*[(x, 18.6, 1.5, 1.0) for x in range(8, 56, 4)])
    light, photometry, noise = observe(patterns, T)
    wrong = 0.04 * np.random.default_rng(0).standard_normal(patterns.count)
    seen = (light.values + wrong[:, np.newaxis] * photometry.rho[:, np.newaxis]).astype(np.float32)

    def off(conditions):
        found = recovered(patterns, (PatternLight.of(seen), photometry, noise), conditions=conditions)
        return np.abs(dense(patterns, found.transport) - T).sum()

    assert off(lobes.Conditions(model_error=0.04)) < 0.8 * off(lobes.Conditions())


def test_shapes_that_do_not_fit_are_refused(patterns, truth, observe):
    light, photometry, noise = observe(patterns, truth((25.3, 18.6, 3.0, 1.0)))
    values = light.values
    for wrong in (values[:, 1:], values[..., :1], values[0], np.repeat(values, 2, axis=0)):
        with pytest.raises(ValueError, match="light must be"):
            lobes.recover(PatternLight.of(wrong), photometry, patterns, noise)
    short = lobes.Conditions(strays=np.ones((2, patterns.count), np.float32))
    with pytest.raises(ValueError, match="strays"):
        lobes.recover(light, photometry, patterns, noise, conditions=short)
    with pytest.raises(ValueError, match="nodes"):
        lobes.recover(light, photometry, replace(patterns, code=patterns.code[:5]), noise)
