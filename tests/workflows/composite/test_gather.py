"""The inner product of a row of T with light, against numpy's."""

from typing import Any

import numpy as np
import pytest
from numba import njit

from workflows.composite.gather import gather


@njit
def gathered(light: Any, cell: Any, weight: Any, start: int, stop: int) -> Any:
    return gather(light, cell, weight, start, stop)


@pytest.mark.parametrize("stop", [*range(7, 17), 499, 500])
@pytest.mark.parametrize("nodes", [1, 40, 10_000])
def test_gathered_light_is_the_weighted_sum(nodes: int, stop: int) -> None:
    rng = np.random.default_rng(stop)
    light = rng.random((nodes + 1, 3), np.float32)
    light[-1] = np.nan  # read along with the last node, and let go
    cell = rng.integers(0, nodes, 500, np.uint32)
    cell[7] = cell[stop - 1] = nodes - 1
    weight = rng.random(500, np.float32)
    expected = (weight[7:stop, None].astype(np.float64) * light[cell[7:stop]]).sum(axis=0)
    np.testing.assert_allclose(gathered(light, cell, weight, 7, stop), expected, rtol=1e-5)
