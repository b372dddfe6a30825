"""Composites of other sizes than the matte's."""

import numpy as np

from workflows.composite.scale import double, shrink


def test_a_smaller_picture_is_the_mean_of_what_was_recovered() -> None:
    picture = np.random.default_rng(0).random((40, 60, 4), np.float32)
    picture[..., 3] = picture[..., 3] < 0.7
    picture[:4, :4, 3] = 0
    small = shrink(picture, 15)
    assert small.shape == (10, 15, 4)
    cell = picture[8:12, 20:24]
    np.testing.assert_allclose(small[2, 5, 3], cell[..., 3].mean(), rtol=1e-6)
    np.testing.assert_allclose(small[2, 5, :3], cell[cell[..., 3] == 1][:, :3].mean(axis=0), rtol=1e-5)
    assert (small[0, 0] == 0).all()
    assert shrink(picture, 60) is picture


def test_a_picture_of_twice_the_size_shows_the_same() -> None:
    y, x = np.mgrid[:40, :70].astype(np.float32)
    picture = np.stack([x / 70, y / 40, x * y / 2800, np.ones_like(x)], axis=2)
    large = double(picture)
    assert large.shape == (80, 140, 4)
    y, x = (np.mgrid[:80, :140].astype(np.float32) - 0.5) / 2
    inside = np.s_[4:-4, 4:-4]
    expected = np.stack([x / 70, y / 40, x * y / 2800, np.ones_like(x)], axis=2)
    np.testing.assert_allclose(large[inside], expected[inside], atol=1e-6)
    # An edge is steeper than by linear interpolation.
    picture[:, 35:, 0], picture[:, :35, 0] = 1, 0
    np.testing.assert_allclose(double(picture)[20, 69:71, 0], [26 / 128, 102 / 128], atol=1e-6)


def test_twice_the_size_has_no_light_of_transparent_pixels() -> None:
    picture = np.full((20, 20, 4), 9, np.float32)
    picture[..., 3] = 0
    picture[5:15, 5:15] = [0.2, 0.4, 0.6, 1]
    large = double(picture)
    seen = large[..., 3] > 0
    assert 20**2 <= np.count_nonzero(seen) <= 24**2
    np.testing.assert_allclose(
        large[seen][:, :3], np.tile(picture[10, 10, :3], (np.count_nonzero(seen), 1)), rtol=1e-4
    )
    assert (large[~seen] == 0).all()
    assert large[..., 3].max() == 1
