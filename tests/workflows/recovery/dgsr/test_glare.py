"""Sensing matrices through glare: those of the filtered patterns, and white stays white."""

import numpy as np
import pytest

from workflows.recovery.dgsr.glare import filter_sensing
from workflows.recovery.glare import filter_patterns, spread_patterns
from workflows.recovery.sensing import Level, Patterns, Sensing

COLUMNS, ROWS = 64, 48
BANDS = [(8, 6, 10), (COLUMNS, ROWS, 10)]
SHARES = [0.03, 0.05, 0.02, 0.04]


@pytest.mark.parametrize("channels", [1, 3])
def test_finest_level_is_that_of_the_filtered_patterns(sensing_of, patterns_of, channels: int) -> None:
    sensing, patterns = sensing_of(BANDS, 1, channels), patterns_of(BANDS, 1, channels)
    spreads = spread_patterns(patterns)
    found = filter_sensing(sensing, spreads, SHARES, COLUMNS, ROWS)
    code = filter_patterns(patterns, spreads, SHARES).code[: COLUMNS * ROWS]
    expected = code.reshape(COLUMNS * ROWS, channels, -1).transpose(1, 0, 2) / 255
    np.testing.assert_allclose(found.levels[-1].light, expected, atol=0.003)
    assert np.abs(found.levels[-1].light - sensing.levels[-1].light).max() > 0.05


def test_coarse_level_has_the_mean_of_its_cells(sensing_of, patterns_of) -> None:
    sensing, patterns = sensing_of(BANDS, 2), patterns_of(BANDS, 2)
    coarse, fine = filter_sensing(sensing, spread_patterns(patterns), SHARES, COLUMNS, ROWS).levels
    means = fine.light[0].reshape(6, 8, 8, 8, -1).mean(axis=(1, 3)).reshape(48, -1)[:, coarse.patterns]
    np.testing.assert_allclose(coarse.light[0], means, atol=0.04)


def test_a_white_monitor_stays_white(patterns_of) -> None:
    patterns = patterns_of(BANDS, 3)
    white = Patterns(patterns.pyramid, 1, np.full_like(patterns.code, 255))
    level = Level(8, 6, np.arange(4), np.ones((1, 48, 4), np.float32))
    found = filter_sensing(Sensing((level,)), spread_patterns(white), SHARES, COLUMNS, ROWS)
    np.testing.assert_allclose(found.levels[0].light, 1, atol=1e-5)
