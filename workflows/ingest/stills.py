"""Read one frame from its image file, and store frames of float values as integers."""

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
"""Full scale relative to the largest value of the white frame: leaves room for noise."""
HIGHLIGHT = 4.0
"""The most that full scale may be, relative to the white frame's 99th percentile: a glint must not cost precision."""


class Storage(NamedTuple):
    """How light is stored.

    Attributes
    ----------
    dtype : numpy.dtype
        Type of the stack: uint8 or uint16.
    black : int
        The stored value of no light. Noise of float values may lie below it.
    full : float
        The light of the largest stored value, in the frames' own units.
    bounded : bool
        Whether the camera itself saturates there.
    """

    dtype: np.dtype[np.unsignedinteger]
    black: int
    full: float
    bounded: bool

    def encode(self, pixels: Codes | Floats) -> Codes:
        """Convert the values of a frame to those that are stored.

        Float values become ``black + value / full * (65535 - black)``, rounded. As with integer files, 0 and 65535
        stand for clipped values; NaN becomes 0.
        """
        if pixels.dtype != np.float32:
            return pixels  # type: ignore[return-value]
        span = np.iinfo(self.dtype).max - self.black
        codes = np.empty(pixels.shape, self.dtype)
        for row, stored in zip(
            pixels, codes, strict=True
        ):  # row by row, so that no second frame is in memory
            scaled = np.nan_to_num(row * np.float32(span / self.full), nan=-np.inf)
            stored[:] = np.rint(np.clip(scaled + np.float32(self.black), 0, np.iinfo(self.dtype).max))
        return codes


def orientation(archive: CaptureArchive, entry: str, limits: Limits) -> int:
    """The orientation that a frame states, for `integer_formats.upright`."""
    data = archive.read(entry)
    with Guard(entry, limits.image).on():
        return camera_raw.orientation(data) if camera_raw.is_raw(entry) else integer_formats.orientation(data)


def read(archive: CaptureArchive, entry: str, limits: Limits, turn: int | None = None) -> Codes | Floats:
    """Decode a frame: PNG, TIFF, JPEG, EXR or camera RAW.

    Parameters
    ----------
    turn : int, optional
        Orientation; by default the one that the file states.

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
    """How to store the frames of an archive, given the first of them.

    Raises
    ------
    CaptureError
        If float frames are said to have a tone curve, or the white frame has no light.

    Notes
    -----
    Integers are stored as they are. Full scale is the white level of RAW. Other float values have no upper limit: full
    scale is then given by the brightest constant frame, in which every pixel is at least as bright as in any pattern.
    """
    if first.dtype != np.float32:
        return Storage(first.dtype, 0, 1.0, True)  # type: ignore[arg-type]
    manifest = archive.manifest
    if manifest.response not in ("linear", "unknown"):
        raise CaptureError(
            'RAW, EXR and float TIFF frames hold linear light: set "response": "linear"',
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
