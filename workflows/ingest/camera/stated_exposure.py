"""The exposures that cameras state in their stills (EXIF, CIPA DC-008): with them, one that was not locked is known."""

from collections.abc import Sequence
from math import isfinite
from typing import BinaryIO

import numpy as np
import pillow_heif
from numpy.typing import NDArray
from PIL import Image

from workflows.images import heif

EXIF = 0x8769
TIME, APERTURE, SENSITIVITY = 0x829A, 0x829D, 0x8827
"""Tags of the exposure time in s, of the f-number and of the ISO."""
FORMATS = ("JPEG", "TIFF")
"""What Pillow opens: of a PNG, it would decode the pixels to look behind them."""
START = 64
"""Bytes that tell a HEIC from other files."""
DIFFER = 0.02
"""Exposures that differ by less are those of a locked camera, as it rounds them."""


def stated_exposure(file: BinaryIO) -> float:
    """The exposure of a still: its time times the ISO by the square of the f-number; 0 if it states no time.

    Camera RAW states it where it is a TIFF inside, as NEF, ARW, CR2 and DNG are. No more is read of a file than needed.
    """
    try:
        start = file.read(START)
        file.seek(0)
        if heif.is_heif(start):
            exif = Image.Exif()
            exif.load(pillow_heif.open_heif(file).info["exif"])
            tags = exif.get_ifd(EXIF)
        else:
            with Image.open(file, formats=FORMATS) as picture:
                tags = picture.getexif().get_ifd(EXIF)
        sensitivity = tags.get(SENSITIVITY) or 1
        if isinstance(sensitivity, tuple):
            sensitivity = sensitivity[0]
        found = float(tags[TIME]) * float(sensitivity) / float(tags.get(APERTURE) or 1) ** 2
    except Exception:  # damaged bytes raise many kinds of errors
        return 0.0
    return found if isfinite(found) and found > 0 else 0.0


def automatic_exposures(stated: Sequence[float] | None) -> NDArray[np.float64] | None:
    """Exposures that are stated, (frames,) with a median of 1; None if they hardly differ.

    Parameters
    ----------
    stated : sequence of float, optional
        As of `stated_exposure`; None of films, and of stills that state none.
    """
    exposures = np.array(stated or [1.0], np.float64)
    if exposures.max() < (1 + DIFFER) * exposures.min():
        return None
    return exposures / np.median(exposures)
