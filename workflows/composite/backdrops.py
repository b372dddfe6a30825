"""The pixels of a picture to the light of a backdrop."""

from typing import cast

import numpy as np

from workflows.composite.light import Backdrop
from workflows.floats import Floats
from workflows.images import Codes
from workflows.pictures import Transfer
from workflows.tone import table


def backdrop_of(pixels: Codes | Floats, transfer: Transfer) -> Backdrop:
    """A backdrop of a picture that `pictures.decode` has decoded.

    Parameters
    ----------
    pixels : (h, w, 1 to 4) uint8 or uint16, or (h, w, 1 or 3) float32
        With an alpha channel if it has two or four. Float values are changed in place.
    transfer : str
        How integers encode light; float values are linear light.

    Returns
    -------
    Backdrop
        Where it is transparent it is black, in part in proportion: there is no light behind it. What is infinite or
        no number in a float image is black.
    """
    if pixels.dtype == np.float32:
        light = cast("Floats", pixels)
        light[~np.isfinite(light)] = 0
        return Backdrop(light)
    codes = cast("Codes", pixels)
    return Backdrop(codes, table(transfer, codes.dtype))
