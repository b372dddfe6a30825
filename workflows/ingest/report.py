"""A report on a capture that a person can act on: what was measured, what it means, and what to do about it."""

from math import floor, log2, log10
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from workflows.program import Constant, Images, Program
from workflows.tone import Curve

Level = Literal["good", "warning", "bad"]
LEVELS: tuple[Level, ...] = ("good", "warning", "bad")


class Finding(BaseModel):
    """One thing that was looked at.

    ``name`` is stable and for machines, ``message`` says what is, ``remedy`` what to do about it: empty if it is good.
    """

    name: str
    level: Level
    message: str
    remedy: str = ""


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
    """How far the camera moved between quarters of the capture, in pixels, and that figure's standard error."""

    pixels: float
    error: float
    quarters: list[tuple[float, float]]


class Flicker(BaseModel):
    """How much the light varied between frames: its deviation, and the frame that is furthest off."""

    percent: float
    worst_percent: float
    worst_frame: int
    frames: int


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
    """PSNR in dB to expect of composites: of glass that scatters or disperses, and of clear glass."""

    low: float
    high: float


class Report(BaseModel):
    """A report on a capture; ``level`` is that of the worst finding."""

    level: Level
    findings: list[Finding]
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


def report(attributes: dict[str, Any], frames: int) -> Report:
    """The report on a capture.

    Parameters
    ----------
    attributes : dict
        Of its stack, as `measure` and `survey` left them.
    frames : int
        Of the stack.
    """
    program = Program.model_validate(attributes["program"])
    survey, noise = attributes["survey"], attributes["noise"]
    said = {"monitor": program.monitor.response, "camera": attributes["response"]}
    curves = {
        name: ToneCurve(
            curve=attributes[f"{name}_curve"],
            source="assumed"
            if name in attributes["assumed_curves"]
            else "estimated"
            if response == "unknown"
            else "given",
        )
        for name, response in said.items()
    }
    made = Report(
        level="good",
        findings=[],
        frames=Frames(
            kept=frames,
            patterns=program.count,
            exposures=len(np.unique(attributes["exposures"])),
            missing=np.setdiff1d(np.arange(program.count), attributes["patterns"]).tolist(),
        ),
        clipping=Clipping(
            white=survey["white"]["clipped_high"],
            black=survey["black"]["clipped_low"],
            patterns_white=survey["patterns"]["clipped_high"],
            patterns_black=survey["patterns"]["clipped_low"],
        ),
        white_reaches=survey["white"]["reaches"],
        drift=survey["drift"],
        flicker=survey["flicker"],
        noise=Noise(
            black=255 * noise["read"] ** 0.5,
            full=255 * (noise["read"] + noise["shot"]) ** 0.5,
            read=noise["read"],
            shot=noise["shot"],
        ),
        crosstalk=attributes["crosstalk"],
        **curves,
        quality=_quality(program, survey),
        video=attributes.get("video"),
    )
    found = [
        _frames(made),
        *_exposure(made, attributes["storage"]),
        *_drift(made.drift),
        *_flicker(made.flicker),
        _noise(made, survey),
        _crosstalk(made, program),
        *_curves(made, program),
    ]
    if made.quality is not None:
        found.append(
            Finding(
                name="quality",
                level="good",
                message=f"composites of about {made.quality.low:.0f} dB (frosted glass, dispersion, many edges) to "
                f"{made.quality.high:.0f} dB (clear glass) are to be expected, if nothing else is wrong",
            )
        )
    level = max((f.level for f in found), key=LEVELS.index)
    return made.model_copy(update={"findings": found, "level": level})


def _graded(value: float, warning: float, bad: float) -> Level:
    return "bad" if value >= bad else "warning" if value >= warning else "good"


def _frames(made: Report) -> Finding:
    missing = made.frames.missing
    if missing:
        return Finding(
            name="frames",
            level=_graded(len(missing) / made.frames.patterns, 0, 0.1),
            message=f"{len(missing)} of {made.frames.patterns} patterns have no frame, the first of them {missing[0]}",
            remedy="show each pattern for longer, or film again",
        )
    several = f", in {made.frames.exposures} exposures" if made.frames.exposures > 1 else ""
    return Finding(
        name="frames",
        level="good",
        message=f"{made.frames.kept} frames of all {made.frames.patterns} patterns{several}",
    )


def _exposure(made: Report, storage: dict[str, Any]) -> list[Finding]:
    found = []
    if storage["bounded"]:
        found.append(_white(made))
    black = made.clipping.black
    level = _graded(black, 0.05, 0.3) if storage["black"] == 0 else "good"
    found.append(
        Finding(
            name="black",
            level=level,
            message=f"the black frame is clipped in {100 * black:.1f} % of the pixels",
            remedy=""
            if level == "good"
            else "raise the camera's black level, let a little light into the room, or film RAW: what lies below black "
            "is lost, and dark glass comes out too bright",
        )
    )
    return found


def _white(made: Report) -> Finding:
    clipped, reach = made.clipping.white, made.white_reaches
    level = _graded(clipped, 0.002, 0.05)
    if level != "good":
        less = "a third of a stop" if clipped < 0.01 else "half a stop" if clipped < 0.05 else "a stop"
        return Finding(
            name="exposure",
            level=level,
            message=f"the white frame is clipped in {100 * clipped:.1f} % of the pixels",
            remedy=f"expose {less} less, or add frames of a shorter exposure",
        )
    level = _graded(-reach, -0.5, -0.15)
    message = f"white reaches {100 * reach:.0f} % of the range"
    if level == "good":
        return Finding(name="exposure", level=level, message=message)
    stops = floor(2 * log2(0.9 / max(reach, 0.01))) / 2
    more = "half a stop" if stops <= 0.5 else "a stop" if stops == 1 else f"{stops:g} stops"
    return Finding(
        name="exposure",
        level=level,
        message=f"white reaches only {message[14:]}",
        remedy=f"expose {more} more",
    )


def _drift(drift: Drift | None) -> list[Finding]:
    if drift is None:
        return []
    # What is within its own error is none.
    level = _graded(drift.pixels if drift.pixels > 2 * drift.error else 0.0, 0.25, 0.75)
    return [
        Finding(
            name="drift",
            level=level,
            message=f"the camera moved by {drift.pixels:.2f} pixels (give or take {drift.error:.2f})",
            remedy=""
            if level == "good"
            else "fix camera, glass and monitor better, release from afar, and film again: it is not corrected",
        )
    ]


def _flicker(flicker: Flicker | None) -> list[Finding]:
    if flicker is None:
        return []
    level = _graded(flicker.percent, 0.5, 2.0)
    return [
        Finding(
            name="flicker",
            level=level,
            message=f"the light varies by {flicker.percent:.2f} % between frames, by {flicker.worst_percent:+.1f} % in "
            f"frame {flicker.worst_frame}",
            remedy=""
            if level == "good"
            else "switch automatic exposure and the monitor's dimming off, let the monitor warm up, and expose "
            "for whole periods of its refresh: it is not corrected",
        )
    ]


def _noise(made: Report, survey: dict[str, Any]) -> Finding:
    ratio = survey["contrast"] / survey["deviation"] if survey["deviation"] else 0.0
    level = _graded(-ratio, -25, -8)
    return Finding(
        name="noise",
        level=level,
        message=f"noise of {made.noise.black:.1f} grey levels of 8 bits at black, {made.noise.full:.1f} at full scale; "
        f"white less black is {ratio:.0f} times that of a pixel between them",
        remedy=""
        if level == "good"
        else "expose longer at a lower ISO, take several frames of each pattern, make the monitor brighter or the room "
        "darker; or the mask takes in pixels that see no monitor",
    )


def _crosstalk(made: Report, program: Program) -> Finding:
    between = float(np.abs(np.array(made.crosstalk) - np.eye(3)).max())
    _, sent = program.constants
    told = np.linalg.matrix_rank(np.concatenate([np.ones((len(sent), 1)), sent], axis=1)) == 4
    if told:
        text = f"the camera's channels see up to {100 * between:.1f} % of the monitor's other colours: it is taken out"
        return Finding(name="crosstalk", level=_graded(between, 0.3, 0.7), message=text)
    coloured = any(getattr(part, "colour", "grey") == "rgb" for part in program.parts)
    return Finding(
        name="crosstalk",
        level="warning" if coloured else "good",
        message="no crosstalk between colours is assumed: the program shows none alone",
        remedy="add constant frames of red, green and blue, as the coloured presets do" if coloured else "",
    )


def _curves(made: Report, program: Program) -> list[Finding]:
    _, sent = program.constants
    greys = not np.isin(sent, (0, 1)).all() or any(isinstance(part, Images) for part in program.parts)
    words = {
        "given": "named by the capture",
        "estimated": "estimated from constant levels",
        "assumed": "only assumed",
    }
    found = []
    for name, curve, matters in (("camera", made.camera, True), ("monitor", made.monitor, greys)):
        assumed = curve.source == "assumed" and matters
        shape = curve.curve if isinstance(curve.curve, str) else f"a gamma of {curve.curve.gamma:g}"
        harmless = "" if matters else "; it makes no difference to black and white"
        found.append(
            Finding(
                name=f"{name}_curve",
                level="warning" if assumed else "good",
                message=f"the {name}'s curve is {shape}, {words[curve.source]}{harmless}",
                remedy=""
                if not assumed
                else "name it in capture.json (`response`), show three or more grey levels, or film the constant ones "
                "in two exposures; RAW needs no curve",
            )
        )
    return found


def _quality(program: Program, survey: dict[str, Any]) -> Quality | None:
    """PSNR to expect, from the noise, the contrast and the number m of patterns.

    Notes
    -----
    The squared error is modelled as ``k s^2 / m + c rho^2 / m^1.2``: noise of the deviation s goes into some k
    parameters of T, S and rho; what the patterns did not ask is the rest, in proportion to the contrast rho. k and c
    are those of the traced scenes that `tests/benchmarks/figures.py` measures, a dispersing solid and a clear ball: k from
    the noise once and four times, c and the power from the presets of 128, 49 and 25 patterns. Ball, solid and a
    frosted lens are at most 2.5 dB outside the range, with the noisy sketch, of which the fit knew nothing.
    """
    patterns = sum(part.count for part in program.parts if not isinstance(part, Constant))
    s2, rho = survey["deviation"] ** 2, survey["contrast"]
    if rho <= 0:
        return None
    low, high = (
        -10 * log10(k * s2 / patterns + c * rho**2 / patterns**1.2) for k, c in ((19.0, 0.040), (5.5, 0.0044))
    )
    return Quality(low=low, high=high)
