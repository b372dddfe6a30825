"""Each method of the benchmark recovers pixels that see one known place."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp

from tests.benchmarks.field.methods.method import Method
from tests.benchmarks.field.methods.rivals import METHODS
from tests.benchmarks.field.scenes import MONITOR, Sample, backdrops, film
from workflows.simulation.scene import Scene

PLACES = np.array([[100.3, 80.7], [180.2, 60.4]])
SPREAD = 2.5
"""Standard deviation of the places, in the monitor's pixels."""
MOST = {"Chuang 2000, one frame": 10.0, "Sen 2009, ROMP": 12.0, "Peers 2009, hierarchical ROMP": 12.0}
"""Pixels that a place may be off, where 3 are too few: one frame is all there is against the noise; in ROMP the shares
of blocks of 64 pixels are a few per cent off."""
QUICK = "sketch", "Gray", "Zongker", "Chuang"
"""Words in the names of the methods whose programs take no seconds to show."""
REPEATED = {
    "envmatte, sketch as filmed",
    "NN-DGSR, 61 frames",
    "NNLS, 61 frames",
    "envmatte, three grids",
    "NN-DGSR, the paper's grids",
}
"""Too few frames for some pixels, or another method with other grids."""
CASES = [
    pytest.param(make, id=name, marks=() if any(word in name for word in QUICK) else pytest.mark.slow)
    for make in METHODS
    if (name := make().name) not in REPEATED
]


@pytest.fixture(scope="module")
def two_places() -> Sample:
    columns, rows = MONITOR
    y, x = np.mgrid[:rows, :columns] + 0.5
    seen = np.exp(-((x - PLACES[:, :1, None]) ** 2 + (y - PLACES[:, 1:, None]) ** 2) / (2 * SPREAD**2))
    seen[seen < 1e-4] = 0
    T = sp.csr_array((seen / seen.sum(axis=(1, 2), keepdims=True)).reshape(2, -1).astype(np.float32))
    return Sample(Scene(1, 2, MONITOR, (T, T, T), np.ones((2, 1), np.float32)), np.arange(2), np.arange(2))


@pytest.mark.parametrize("make", CASES)
def test_a_pixel_that_sees_one_place_is_recovered(make: Callable[[], Method], two_places: Sample) -> None:
    method = make()
    if method.name.startswith(("lasso", "OMP")):
        pytest.importorskip("sklearn", reason="scikit-learn is in the extra `bench`")
    matte = method.recover(film(two_places, method))
    black, white = (matte.composite(np.full((*MONITOR[::-1], 3), level, np.float32)) for level in (0, 1))
    seen = (matte.composite(backdrops()["ramps"]) - black) / (white - black)
    assert seen[:, :2] * MONITOR == pytest.approx(PLACES, abs=MOST.get(method.name, 3.0))
    assert black == pytest.approx(0.02, abs=0.01)
    assert white == pytest.approx(0.92, abs=0.05)
