"""The inner product of a row of T with light, against numpy's."""

from typing import Any

import numpy as np
import pytest
from numba import njit

from workflows.composite.gather import gather


@njit
def gathered(light: Any, step: Any, code: Any, first: int, start: int, stop: int) -> Any:
    return gather(light, step, code, first, start, stop)


@pytest.mark.parametrize("stop", [*range(8, 17), 499, 500])
@pytest.mark.parametrize("nodes", [1, 40, 100_000])
def test_gathered_light_is_the_weighted_sum(nodes: int, stop: int) -> None:
    rng = np.random.default_rng(stop)
    light = rng.random((nodes + 1, 3), np.float32)
    light[-1] = np.nan  # read along with the last node, and let go
    cell = np.sort(rng.integers(0, nodes, stop - 7))
    cell[-1] = nodes - 1
    step = rng.integers(0, 1 << 16, 500, np.uint16)
    step[7] = 0
    step[8:stop] = np.minimum(np.diff(cell), 65535)
    cell = cell[0] + np.cumsum(step[7:stop], dtype=int)
    code = rng.integers(0, 1 << 16, 500, np.uint16)
    code[7], code[stop - 1] = 0, 65535
    expected = (code[7:stop, None].astype(np.float64) * light[cell]).sum(axis=0)
    found = gathered(light, step, code, int(cell[0]), 7, stop)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
