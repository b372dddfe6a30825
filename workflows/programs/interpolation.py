"""The light of patterns that a monitor shows at another size, and so interpolates between their pixels."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from workflows.images.tone_curves import Curve, to_light

PLACES = 16
"""Along each side of a quarter of a pixel, at which its light is worked out."""

Floats = NDArray[np.float32]


def interpolated_light(picture: NDArray[np.bool_], curve: Curve) -> Floats:
    """The light of a black and white picture that is shown at another size.

    Zoomed pages and players interpolate bilinearly between the codes of neighbouring pixels. Along an edge the light of
    these codes is less than half of white's: a fine pattern is darker than a coarse one.

    Parameters
    ----------
    picture : (rows, columns) bool
        Which pixels are white.
    curve : Curve
        The monitor's, from code to light.

    Returns
    -------
    (rows, columns) float32
        The mean light over each pixel, 0 to 1, whatever the size that it is shown at.

    Examples
    --------
    >>> edge = np.array([[False, False, True, True]])
    >>> interpolated_light(edge, "linear").tolist()
    [[0.0, 0.125, 0.875, 1.0]]
    >>> (100 * interpolated_light(edge, "srgb")).round().tolist()
    [[0.0, 3.0, 78.0, 100.0]]
    """
    light = np.empty(picture.shape, np.float32)
    _add_quarters(np.pad(picture, 1, mode="edge").astype(np.uint8), _quarters(curve), light)
    return light


def _quarters(curve: Curve) -> Floats:
    """What a quarter of a pixel adds to its mean light, (2, 2, 2, 2) float32.

    The indices say whether the pixel is white, its neighbour beside, the one above or below, and the one between these.
    """
    off = (np.arange(PLACES) + 0.5) / (2 * PLACES)  # from the pixel's middle towards its edge
    share = np.stack([1 - off, off])
    white = np.indices((2, 2, 2, 2)).reshape(2, 2, 16)  # which row, which column; all cases
    codes = np.einsum("rck,ri,cj->kij", white, share, share).astype(np.float32)
    light: Floats = to_light(codes, curve).mean(axis=(1, 2)) / 4
    return light.reshape(2, 2, 2, 2)


@njit(nogil=True, cache=True)
def _add_quarters(white: NDArray[np.uint8], quarters: Floats, light: Floats) -> None:
    """See `interpolated_light`; the picture is padded by one pixel."""
    rows, columns = light.shape
    for y in range(rows):
        for x in range(columns):
            total, own = np.float32(0), white[y + 1, x + 1]
            for row in (y, y + 2):
                for column in (x, x + 2):
                    total += quarters[own, white[y + 1, column], white[row, x + 1], white[row, column]]
            light[y, x] = total
