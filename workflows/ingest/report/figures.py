"""The figures in the report on a capture, and what is found by them."""

from typing import Any, Literal

from pydantic import BaseModel, ValidationInfo, field_validator

from workflows.images.tone_curves import CameraCurve

Level = Literal["good", "warning", "bad"]
LEVELS: tuple[Level, ...] = ("good", "warning", "bad")


class Finding(BaseModel):
    """One aspect of a capture.

    ``name`` is stable, for programs. ``message`` says what was found, and ``remedy`` what to do about it; it is dropped
    if the level is good. ``cost`` is the mean square error that composites have by it, of full scale, or None if that
    is not known.
    """

    name: str
    level: Level
    message: str
    remedy: str = ""
    cost: float | None = None

    @field_validator("remedy")
    @classmethod
    def _none_if_good(cls, remedy: str, info: ValidationInfo) -> str:
        return "" if info.data["level"] == "good" else remedy


def graded(value: float, warning: float, bad: float) -> Level:
    """The level of a value that is the worse the larger it is."""
    return "bad" if value >= bad else "warning" if value >= warning else "good"


class Frames(BaseModel):
    """The numbers of frames kept, of patterns and of exposures, and the patterns without a frame."""

    kept: int
    patterns: int
    exposures: int
    missing: list[int]


class Clipping(BaseModel):
    """Shares of clipped pixels, 0 to 1: at white in the white frame, at black in the black one, and in the patterns."""

    white: float
    black: float
    patterns_white: float
    patterns_black: float


class Drift(BaseModel):
    """The largest distance between the positions of two frames, and the standard error of a position, in pixels.

    ``quarters`` are the mean positions, x and y, in each quarter of the capture. ``corrected`` says whether recovery
    shifts the frames back.
    """

    pixels: float
    error: float
    quarters: list[tuple[float, float]]
    corrected: bool


class Flicker(BaseModel):
    """How much the monitor's light varied between frames, in per cent: standard deviation and worst frame.

    ``error`` is the standard error of a frame. ``follows`` is the correlation of the frames' light with the patterns'
    own. ``white_percent`` is by how much white frames are brighter than what is white in patterns, if that is known.
    ``corrected`` says whether recovery corrects it.
    """

    percent: float
    error: float
    worst_percent: float
    worst_frame: int
    follows: float = 0.0
    white_percent: float = 0.0
    frames: int
    corrected: bool


class Noise(BaseModel):
    """Standard deviations of the noise at black and at full scale, in grey levels of 8 bits in linear light.

    A value v has the variance ``read + shot v``; full scale is 1.
    """

    black: float
    full: float
    read: float
    shot: float


Source = Literal["given", "estimated", "assumed"]
"""Where a tone curve is known from."""


class ToneCurve(BaseModel):
    """A tone curve, and whether the capture states it, or it was estimated from constant levels, or is assumed.

    A camera whose channels differ has one for each.
    ``apart`` is the largest difference between the light of half-tones by this curve and what they should have, as a
    share of white's; None if there are none.
    """

    curve: CameraCurve
    source: Source
    apart: float | None = None


class Quality(BaseModel):
    """The PSNR to expect of composites in dB: ``low`` for difficult, ``high`` for easy glass.

    If no random grid has offsets, ``blocks`` is the number of blocks of the finest one along the monitor's shorter
    side; then clear glass is the most difficult, and frosted glass the easiest. Otherwise it is None, and clear glass
    the easiest.
    """

    low: float
    high: float
    blocks: int | None


class Figures(BaseModel):
    """Everything that was measured of a capture."""

    frames: Frames
    clipping: Clipping
    white_reaches: float
    drift: Drift | None
    flicker: Flicker | None
    noise: Noise
    crosstalk: list[list[float]]
    monitor: ToneCurve
    camera: ToneCurve
    quality: Quality | None
    video: dict[str, Any] | None
