"""The eight orientations of a picture, as EXIF counts them."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)
ORIENTATION = 274
"""The EXIF tag of the orientation."""


def upright(pixels: NDArray[T], turn: int) -> NDArray[T]:
    """Turn pixels upright by an orientation.

    Parameters
    ----------
    pixels : (h, w, ...)
    turn : int
        EXIF orientation, tag 274 (CIPA DC-008, sect. 4.6.5). It says where row 0 and column 0 of the pixels are in the
        upright picture. 1: top, left; 2: top, right; 3: bottom, right; 4: bottom, left; 5: left, top; 6: right, top;
        7: right, bottom; 8: left, bottom.

    Returns
    -------
    (h, w, ...) or (w, h, ...)
        In C order.
    """
    if turn > 4:
        pixels = pixels.swapaxes(0, 1)
    down, across = turn in (3, 4, 7, 8), turn in (2, 3, 6, 7)
    return np.ascontiguousarray(pixels[:: -1 if down else 1, :: -1 if across else 1])


def inverse(turn: int) -> int:
    """The orientation that undoes another: ``upright(upright(pixels, turn), inverse(turn))`` are the pixels."""
    return {6: 8, 8: 6}.get(turn, turn)
