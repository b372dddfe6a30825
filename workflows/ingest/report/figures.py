"""The figures of a report: what was measured of a capture."""

from typing import Any, Literal

from pydantic import BaseModel

from workflows.images.tone_curves import Curve


class Frames(BaseModel):
    """How many frames were kept, of how many patterns, in how many exposures, and the patterns without a frame."""

    kept: int
    patterns: int
    exposures: int
    missing: list[int]


class Clipping(BaseModel):
    """Shares of the pixels, 0 to 1: at white in the white frame, at black in the black one, and of both in patterns."""

    white: float
    black: float
    patterns_white: float
    patterns_black: float


class Drift(BaseModel):
    """The largest distance between two frames' places in pixels, and the standard error of a frame's place.

    ``quarters`` are the mean places in the quarters of the capture, x and y. ``corrected``: recovery moves frames back.
    """

    pixels: float
    error: float
    quarters: list[tuple[float, float]]
    corrected: bool


class Flicker(BaseModel):
    """How much the monitor's light varied between frames, in per cent: its deviation, and the frame furthest off.

    ``error`` is the standard error of a frame's. ``corrected``: recovery takes it out.
    """

    percent: float
    error: float
    worst_percent: float
    worst_frame: int
    frames: int
    corrected: bool


class Noise(BaseModel):
    """Standard deviations in grey levels of 8 bits, in linear light: before a black monitor, and at full scale.

    ``read`` and ``shot`` are the variance ``read + shot v`` of a value v, full scale being 1.
    """

    black: float
    full: float
    read: float
    shot: float


class ToneCurve(BaseModel):
    """A tone curve, and whether the capture names it, constant levels tell it, or it is only assumed."""

    curve: Curve
    source: Literal["given", "estimated", "assumed"]


class Quality(BaseModel):
    """PSNR in dB to expect of composites, of worse and of better glass.

    ``blocks`` is how many the finest random grid has along the monitor's shorter side if no grid has offsets: then
    clear glass is worst and frosted glass best. Else it is None, and clear glass best.
    """

    low: float
    high: float
    blocks: int | None


class Figures(BaseModel):
    """What was measured of a capture."""

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
