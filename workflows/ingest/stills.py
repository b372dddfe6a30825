"""One frame from its file, and how frames of float values are stored as integers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from storage.errors import CaptureError, ImageError
from workflows.images import camera_raw, float_formats, integer_formats
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import BLACK
from workflows.ingest.archive import CaptureArchive
from workflows.ingest.manifest import MANIFEST
from workflows.untrusted.decoder_guard import Guard
from workflows.untrusted.limits import Limits

HEADROOM = 1.05
"""Full scale over the largest value of the white frame, for noise."""
HIGHLIGHT = 4.0
"""Full scale over the 99th percentile of the white frame, at most: a glint must not cost the rest its precision."""


class Storage(NamedTuple):
    """How light is stored.

    Attributes
    ----------
    dtype : numpy.dtype
        Of the stack: uint8 or uint16.
    black : int
        The stored value of no light. Float values may lie below it, by noise.
    full : float
        The light, in the frames' own units, of the largest stored value.
    bounded : bool
        Whether the camera ends there, or only what is stored.
    """

    dtype: np.dtype[np.unsignedinteger]
    black: int
    full: float
    bounded: bool

    def encode(self, pixels: Codes | Floats) -> Codes:
        """Values of a frame as they are stored.

        Float values become ``black + value / full * (65535 - black)``, rounded; 0 and 65535 are left to
        what lies outside or is no number, as they are in files of integers.
        """
        if pixels.dtype != np.float32:
            return pixels  # type: ignore[return-value]
        span = np.iinfo(self.dtype).max - self.black
        codes = np.empty(pixels.shape, self.dtype)
        for row, stored in zip(pixels, codes, strict=True):  # a row at a time: no second frame in memory
            scaled = np.nan_to_num(row * np.float32(span / self.full), nan=-np.inf)
            stored[:] = np.rint(np.clip(scaled + np.float32(self.black), 0, np.iinfo(self.dtype).max))
        return codes


def orientation(archive: CaptureArchive, entry: str, limits: Limits) -> int:
    """How a frame says that it is to be turned to be upright, as `images.upright` takes it."""
    data = archive.read(entry)
    with Guard(entry, limits.image).on():
        return camera_raw.orientation(data) if camera_raw.is_raw(entry) else integer_formats.orientation(data)


def read(archive: CaptureArchive, entry: str, limits: Limits, turn: int | None = None) -> Codes | Floats:
    """Decode a frame: PNG, TIFF, JPEG, EXR, camera RAW.

    Parameters
    ----------
    turn : int, optional
        How it is turned, whatever it says itself; default as it says.

    Returns
    -------
    (height, width, 1 or 3) uint8, uint16 or float32
        Float values are linear light.

    Raises
    ------
    CaptureError
        Naming the entry.
    """
    data = archive.read(entry)
    try:
        with Guard(entry, limits.image).on():
            if camera_raw.is_raw(entry):
                return camera_raw.decode(data, memory=limits.image, turn=turn)
            if float_formats.is_float(data):
                return float_formats.decode(data, memory=limits.image, turn=turn)
            return integer_formats.decode(data, memory=limits.image, turn=turn)
    except ImageError as error:
        raise CaptureError(f"{entry}: {error.detail}", entry=entry, **error.fields) from error


def storage_of(archive: CaptureArchive, first: NDArray[np.generic], limits: Limits) -> Storage:
    """How the frames of a archive are to be stored, by its first.

    Raises
    ------
    CaptureError
        If float frames are said to have a curve, or the white one has no light.

    Notes
    -----
    Integers are stored as they are. RAW ends at its white level. Other float values have no upper end: full scale is
    that of the brightest constant frame, whose every pixel is at least as bright as before any pattern.
    """
    if first.dtype != np.float32:
        return Storage(first.dtype, 0, 1.0, True)  # type: ignore[arg-type]
    manifest = archive.manifest
    if manifest.response not in ("linear", "unknown"):
        raise CaptureError(
            'RAW, EXR and float TIFF frames hold linear light: say so, "response": "linear"',
            entry=MANIFEST,
            field="response",
        )
    numbers, sent = manifest.program.constants
    white = int(numbers[np.argmax(sent.sum(axis=1))])
    frames = [frame for frame in manifest.frames if frame.pattern == white]
    entry = max(frames, key=lambda frame: frame.exposure).file
    full, bounded = 1.0, camera_raw.is_raw(entry)
    if not bounded:
        values = read(archive, entry, limits)
        finite = values[np.isfinite(values)]
        full = 0.0
        if finite.size:
            full = HEADROOM * min(float(finite.max()), HIGHLIGHT * float(np.percentile(finite, 99)))
    if full <= 0:
        raise CaptureError(f"{entry}, the brightest constant frame, holds no light", entry=entry)
    return Storage(np.dtype(np.uint16), BLACK, full, bounded)
