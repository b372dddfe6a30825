"""The order in which tiles are done."""

import numpy as np
import pytest

from workflows.ingest.steps import STEPS as INGEST
from workflows.jobs import order
from workflows.mattes.steps import STEPS as RECOVER


@pytest.mark.parametrize("count", [1, 7, 30, 1000])
def test_tiles_of_a_matte_are_spread_over_it(count: int) -> None:
    tiles = order(RECOVER, range(count))
    assert sorted(tiles) == list(range(count))
    assert order(RECOVER, tiles[count // 2 :]) == tiles[count // 2 :]
    if count >= 30:
        fifth = np.histogram(tiles[: count // 5], bins=5, range=(0, count))[0]
        assert np.ptp(fifth) <= 2


def test_slabs_of_a_capture_are_in_sequence() -> None:
    assert order(INGEST, [3, 0, 2]) == [0, 2, 3]
