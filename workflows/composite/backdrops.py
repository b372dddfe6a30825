"""The pixels of a picture to the light of a backdrop."""

from typing import cast

import numpy as np

from workflows import images
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
        return Backdrop(np.nan_to_num(light, copy=False, nan=0, posinf=0, neginf=0))
    codes = cast("Codes", pixels)
    light_of = table(transfer, codes.dtype)
    if codes.shape[2] in (1, 3):
        return Backdrop(codes, light_of)
    colours, alpha = codes[..., :-1], codes[..., -1:]
    top = np.iinfo(codes.dtype).max
    if (alpha == top).all():
        return Backdrop(colours, light_of)
    return Backdrop(light_of.take(colours) * images.to_unit(alpha))
