"""Homographies: through four points, and by least squares through more."""

import numpy as np
import pytest

from workflows.recovery.camera.homography import fit_homography

TRUE = np.array([(1.2, 0.1, 3), (-0.2, 0.9, 5), (0.05, 0.02, 1)])


@pytest.mark.parametrize("count", [4, 200])
def test_a_perspective_is_found_again(count: int) -> None:
    random = np.random.default_rng(0)
    x, y = random.random((2, count))
    u, v, w = TRUE @ (x, y, np.ones(count))
    noise = 0 if count == 4 else 1e-6 * random.standard_normal((count, 2))
    assert fit_homography(x, y, np.stack([u / w, v / w], axis=1) + noise) == pytest.approx(TRUE, abs=1e-4)
