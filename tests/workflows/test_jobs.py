"""The order in which tiles are done."""

import numpy as np
import pytest

from workflows.jobs import order


@pytest.mark.parametrize("count", [1, 7, 30, 1000])
def test_tiles_of_a_matte_are_taken_from_all_over_it(count: int) -> None:
    tiles = order("recover", range(count))
    assert sorted(tiles) == list(range(count))
    assert order("recover", tiles[count // 2 :]) == tiles[count // 2 :]
    if count >= 30:
        fifth = np.histogram(tiles[: count // 5], bins=5, range=(0, count))[0]
        assert np.ptp(fifth) <= 2


def test_tiles_of_a_capture_come_one_after_another() -> None:
    assert order("ingest", [3, 0, 2]) == [0, 2, 3]
