"""The perspective of a camera in front of a plane."""

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


def fit_homography(x: Doubles, y: Doubles, seen: Doubles) -> Doubles:
    """The homography that maps points to where they are seen, by linear least squares.

    Parameters
    ----------
    x, y : (n,) float64
        Four points or more.
    seen : (n, 2) float64
        Where they are seen.

    Returns
    -------
    (3, 3) float64
        From (x, y, 1); its last entry is 1.

    References
    ----------
    Hartley and Zisserman, Multiple View Geometry in Computer Vision, 2nd ed., 2004, ch. 4.

    Examples
    --------
    >>> corners = np.array([(0.0, 0), (1, 0), (0, 1), (1, 1)])
    >>> np.allclose(fit_homography(*corners.T, 2 * corners + (3, 4)), [(2, 0, 3), (0, 2, 4), (0, 0, 1)])
    True
    """
    u, v = seen.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=1),
        ]
    )
    found, *_ = np.linalg.lstsq(rows, np.concatenate([u, v]), rcond=None)
    return np.append(found, 1.0).reshape(3, 3)
