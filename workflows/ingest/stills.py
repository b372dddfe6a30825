"""Read one frame from its image file, and store frames of float values as integers."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from storage.errors import CaptureError, ImageError
from workflows.images import camera_raw, float_formats, hdr, integer_formats, raw_files
from workflows.images.float_formats import Floats
from workflows.images.integer_formats import Codes
from workflows.images.tone_curves import BLACK, table
from workflows.ingest.archive import CaptureArchive
from workflows.ingest.camera.stated_exposure import stated_exposure
from workflows.ingest.manifest import MANIFEST, Manifest
from workflows.untrusted.decoder import Decoder, blaming

HEADROOM = 1.05
"""Full scale relative to the largest value of the white frame: leaves room for noise."""
HIGHLIGHT = 4.0
"""The largest value that full scale makes room for, relative to the white frame's 99th percentile: a glint must not
cost precision."""

LOOKED_AT = 1 << 20
"""Pixels of HDR, spread over the frame, that its full scale is found from."""


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
        # Row by row, so that no second frame is in memory.
        for row, stored in zip(pixels, codes, strict=True):
            scaled = np.nan_to_num(row * np.float32(span / self.full), nan=-np.inf)
            stored[:] = np.rint(np.clip(scaled + np.float32(self.black), 0, np.iinfo(self.dtype).max))
        return codes


class Header(BaseModel):
    """What a frame's file says of itself.

    Attributes
    ----------
    raw : bool
        Whether it is camera RAW.
    orientation : int
        For `workflows.images.orientation.upright`.
    half_colour : bool
        Whether it stores colour at half the resolution, as most JPEG and HEIC do.
    transfer : int
        See `workflows.images.integer_formats.transfer`.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    raw: bool
    orientation: Annotated[int, Field(ge=1, le=8)]
    half_colour: bool
    transfer: Annotated[int, Field(ge=0, le=0xFFFF)]


class Exposure(BaseModel):
    """What a frame's file says of its exposure, 0 for nothing."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    exposure: Annotated[float, Field(ge=0)]


def header(decoder: Decoder, archive: CaptureArchive, entry: str) -> Header:
    """Read what a frame's file says of itself.

    Raises
    ------
    CaptureError
        If that takes too much memory.
    """
    data = archive.read(entry)
    with blaming(entry, decoder), decoder.checking():
        (found,) = decoder.run(_header, data, entry=entry)
        return Header.model_validate(found)


def exposures(decoder: Decoder, archive: CaptureArchive) -> list[float] | None:
    """The exposure that each frame's file states, see `workflows.ingest.camera.stated_exposure`.

    None if not all state one, or if capture.json tells exposures apart.
    """
    frames, found = archive.manifest.frames, list[float]()
    if len({frame.exposure for frame in frames}) > 1:
        return None
    for frame in frames:
        with archive.open(frame.file) as file, blaming(frame.file, decoder), decoder.checking():
            (stated,) = decoder.run(_exposure, file)
            found.append(Exposure.model_validate(stated).exposure)
        if not found[-1]:
            return None
    return found


def read(
    decoder: Decoder, archive: CaptureArchive, entry: str, turn: int | None = None, full: float = 1.0
) -> Codes | Floats:
    """Decode a frame: PNG, TIFF, JPEG, HEIC, EXR, Radiance HDR or camera RAW.

    Parameters
    ----------
    turn : int, optional
        Orientation; by default the one that the file states.
    full : float
        The light of HEIC for HDR displays that becomes full scale.

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
    with blaming(entry, decoder):
        return decoder.picture(_decode, data, entry=entry, memory=decoder.image_bytes, turn=turn, full=full)


def read_integers(decoder: Decoder, archive: CaptureArchive, entry: str) -> Codes:
    """Decode a pattern or a mask: PNG, TIFF, JPEG or HEIC.

    Raises
    ------
    CaptureError
        Naming the entry.
    """
    data = archive.read(entry)
    with blaming(entry, decoder):
        return decoder.picture(_decode_integers, data, entry=entry, memory=decoder.image_bytes)


def storage_of(
    decoder: Decoder, archive: CaptureArchive, first: NDArray[np.generic], transfer: int
) -> Storage:
    """How to store the frames of an archive, given the first of them and its transfer characteristics.

    Raises
    ------
    CaptureError
        If float frames are said to have a tone curve, or the white frame has no light, or is clipped everywhere.

    Notes
    -----
    Integers are stored as they are, those for HDR displays as sRGB. Full scale is the white level of RAW. Other float
    values have no upper limit: full scale is then given by the brightest constant frame, in which every pixel is at
    least as bright as in any pattern. That of HDR is white, or more if it and the darkest show the monitor brighter.
    """
    manifest = archive.manifest
    if first.dtype != np.float32:
        full = _full_scale(decoder, archive, first, transfer) if hdr.is_hdr(transfer) else 1.0
        return Storage(first.dtype, 0, full, True)  # type: ignore[arg-type]
    if manifest.response not in ("linear", "unknown"):
        raise CaptureError(
            'RAW, EXR and float TIFF frames hold linear light: set "response": "linear"',
            entry=MANIFEST,
            field="response",
        )
    entry = _constants(manifest)[1]
    full, bounded = 1.0, header(decoder, archive, entry).raw
    if not bounded:
        values = read(decoder, archive, entry)
        finite = values[np.isfinite(values)]
        full = 0.0
        if not finite.size and np.isposinf(values).any():
            raise CaptureError(f"{entry} is clipped everywhere: expose shorter", entry=entry)
        if finite.size:
            full = HEADROOM * min(float(finite.max()), HIGHLIGHT * float(np.percentile(finite, 99)))
    if full <= 0:
        raise CaptureError(f"{entry}, the brightest constant frame, holds no light", entry=entry)
    return Storage(np.dtype(np.uint16), BLACK, full, bounded)


def _constants(manifest: Manifest) -> tuple[str, str]:
    """The frames of the darkest and of the brightest constant pattern, each in its longest exposure."""

    def longest(pattern: np.intp) -> str:
        frames = [frame for frame in manifest.frames if frame.pattern == pattern]
        return max(frames, key=lambda frame: frame.exposure).file

    darkest, brightest = manifest.program.ends([frame.pattern for frame in manifest.frames])
    return longest(darkest[0]), longest(brightest[0])


def _full_scale(
    decoder: Decoder, archive: CaptureArchive, first: NDArray[np.generic], transfer: int
) -> float:
    """The light that HEICs for HDR displays are to have at full scale, see `workflows.images.hdr.full_scale`."""
    most = float(hdr.light_of_hdr(transfer)[-1])
    frames = [read(decoder, archive, entry, full=most) for entry in _constants(archive.manifest)]
    if any(frame.dtype != np.uint16 or frame.shape != first.shape for frame in frames):
        return 1.0  # refused when they are read to be stored
    look_up = most * table("srgb", np.dtype(np.uint16))
    step = -(-first.shape[0] * first.shape[1] // LOOKED_AT)
    darkest, brightest = (look_up[frame.reshape(-1, frame.shape[2])[::step]] for frame in frames)
    return hdr.full_scale(transfer, brightest, darkest)


# What follows runs in a decoder.


def _header(file: BinaryIO, entry: str) -> Iterator[dict[str, Any]]:
    data = file.read()
    raw = raw_files.is_raw(data, entry)
    turn = camera_raw.orientation(data) if raw else integer_formats.orientation(data)
    yield {
        "raw": raw,
        "orientation": turn,
        "half_colour": not raw and integer_formats.halves_colour(data),
        "transfer": 0 if raw else integer_formats.transfer(data),
    }


def _exposure(file: BinaryIO) -> Iterator[dict[str, float]]:
    yield {"exposure": stated_exposure(file)}


def _decode(
    file: BinaryIO, entry: str, memory: int, turn: int | None, full: float
) -> Iterator[Codes | Floats]:
    data = file.read()
    with _naming(entry):
        if raw_files.is_raw(data, entry):
            yield camera_raw.decode(data, memory=memory, turn=turn)
        elif float_formats.is_float(data):
            yield float_formats.decode(data, memory=memory, turn=turn)
        else:
            yield integer_formats.decode(data, memory=memory, turn=turn, full=full)


def _decode_integers(file: BinaryIO, entry: str, memory: int) -> Iterator[Codes]:
    with _naming(entry):
        yield integer_formats.decode(file.read(), memory=memory)


@contextmanager
def _naming(entry: str) -> Iterator[None]:
    """Begin errors with the name of the file."""
    try:
        yield
    except ImageError as error:
        raise ImageError(f"{entry}: {error.detail}", **error.fields) from error.__cause__
