"""Findings on what limits composites, and on what could not be measured."""

from math import log10
from typing import Any

import numpy as np

from workflows.images.tone_curves import CameraCurve, Sampled, to_light
from workflows.ingest.camera.border_exposure import is_free
from workflows.ingest.report.expected_psnr import beside_noise
from workflows.ingest.report.figures import Figures, Finding, Quality, ToneCurve, graded
from workflows.programs.parts import Images
from workflows.programs.program import Program

SHOWS, SPOILS = 1e-4, 6e-3
"""Mean squares of errors, of full scale, from which on they show (40 dB), and spoil composites (22 dB)."""
FEW, TOO_FEW = 30.0, 22.0
"""PSNR in dB below which composites differ visibly from a photograph, and are of no use."""
BLOWN = 0.9
"""Share of the picture that is clipped at white from which on nothing is promised. Composites of a traced ball were
within 3 dB of the range at 0.90, and 7 dB below it at 0.96, 22 at 0.999."""
APART = 0.03
"""Difference of half-tones from their light by the camera's curve, as a share of white's, that is more than local tone
mapping and flicker make."""


def quality(expected: Quality | None, *, random: bool, exposed: bool) -> Finding | None:
    """The PSNR to expect, graded by the middle of its range.

    Parameters
    ----------
    expected : Quality or None
    random : bool
        Whether the program has random patterns.
    exposed : bool
        Whether the camera's exposure was not locked, which decides the low end of a program with random patterns.
    """
    if expected is None:
        return None
    if not random:
        worst, best, why = "backdrops finer than the patterns", "coarser ones", ""
    elif expected.blocks is None:
        worst, best, why = "dispersion, many edges", "clear glass", ""
    else:
        worst, best = "clear glass, many edges", "frosted glass"
        why = (
            f": the random grids have no offsets, so light is located no finer than a block of the finest grid, with "
            f"{expected.blocks} along the shorter side. Patterns with offsets, as in the preset `default`, do better"
        )
    if exposed and random:
        worst, best = "if the scene is to be exposed otherwise", "exposed as white was"
    low, high = f"{expected.low:.0f}", f"{expected.high:.0f}"
    span = f"{low} dB" if low == high else f"{low} dB ({worst}) to {high} dB ({best})"
    level = graded(-(expected.low + expected.high) / 2, -FEW, -TOO_FEW)
    return Finding(
        name="quality",
        level=level,
        message=f"expect composites of about {span}, if nothing else is wrong{why}",
        remedy="follow the other findings, first the one that costs most; show more patterns, as the preset "
        "`default` does",
    )


def unexplained(cost: float, share: float) -> Finding | None:
    """What neither T nor noise explains."""
    if cost < SHOWS:
        return None
    return Finding(
        name="unexplained",
        level=graded(cost, SHOWS, SPOILS),
        message=f"{100 * share:.1f} % of the light is explained neither by the patterns nor by noise, as with "
        f"sharpening, compression or scattered light: that alone limits composites to about {_dB(cost)} dB",
        remedy="switch HDR, sharpening and noise reduction of the camera off, shoot RAW, or film at a higher bit "
        "rate",
        cost=cost,
    )


def lost_colour(program: Program, cost: float, *, half_colour: bool) -> Finding | None:
    """Detail of colours, of the patterns or else of the glass, that frames don't hold.

    Parameters
    ----------
    program : Program
    cost : float
        The mean square error of composites by it.
    half_colour : bool
        Whether the frames are stills that store colours at half the resolution. (Films show no patterns in colour.)
    """
    limit = f"that alone limits composites to about {_dB(cost)} dB" if cost >= SHOWS else ""
    if half_colour and program.in_colour:
        return Finding(
            name="coloured_patterns",
            level=graded(cost, 0, SPOILS),
            message="the patterns are in colour, which these frames store at half the resolution: "
            + (limit or "that costs composites up to 8 dB"),
            remedy="shoot RAW, or show patterns in black and white: `envmatte patterns --grey`",
            cost=cost or None,
        )
    if not limit:
        return None
    return Finding(
        name="colour_detail",
        level="warning",
        message=f"the colours of the glass are finer than its frames store them, at half the resolution: {limit}",
        remedy="let the glass fill more of the frame, or shoot RAW",
        cost=cost,
    )


def camera_curve(camera: ToneCurve, *, linear: bool, dimmed: bool) -> Finding | None:
    """The camera's curve: measured, assumed, or stated and right or wrong.

    Parameters
    ----------
    camera : ToneCurve
    linear : bool
        Whether the frames' format holds linear light.
    dimmed : bool
        Whether white differs between white frames and patterns: then half-tones do not tell whether a curve is right.
    """
    apart = None if dimmed else camera.apart
    if camera.source == "assumed":
        return _assumed("camera", camera.curve)
    if camera.source == "given" and apart is not None and abs(apart) > APART:
        return Finding(
            name="camera_curve",
            level="warning",
            message=f"the camera's curve is {_shape(camera.curve)}, stated by the capture, but by this curve "
            f"half-tones are off by {100 * apart:+.0f} % of white",
            remedy='set `"response": "unknown"` in capture.json: the curve is then measured from the half-tones',
        )
    if linear:
        how = "as the format of the frames says"
    elif camera.source == "estimated" and not dimmed:
        how = "estimated from constant levels and half-tones"
    elif apart is not None:
        how = "stated by the capture, and half-tones agree"
    else:
        return None
    return Finding(
        name="camera_curve",
        level="good",
        message=f"the camera's curve is {_shape(camera.curve)}, {how}",
    )


def monitor_curve(monitor: ToneCurve, program: Program) -> Finding | None:
    """The monitor's curve, unless it is stated and makes a difference."""
    matters = _shows_greys(program)
    if monitor.source == "assumed" and matters:
        return _assumed("monitor", monitor.curve)
    if monitor.source == "given" and matters:
        return None
    how = {
        "given": "stated by the capture",
        "estimated": "estimated from constant levels",
        "assumed": "only assumed",
    }[monitor.source]
    harmless = "" if matters else "; it makes no difference to black and white"
    return Finding(
        name="monitor_curve",
        level="good",
        message=f"the monitor's curve is {_shape(monitor.curve)}, {how}{harmless}",
    )


def unmeasured(figures: Figures, program: Program, attributes: dict[str, Any]) -> Finding | None:
    """What could not be measured, all in one."""
    lacking: list[str] = []
    remedies: dict[str, None] = {}

    def lacks(what: str, remedy: str) -> None:
        lacking.append(what)
        remedies[remedy] = None

    blown = is_blown(attributes["survey"])
    larger = "expose less" if blown else "show the object larger and brighter in the picture"
    steady = larger if attributes.get("steadiness") is None else "shoot RAW, with nothing that moves"
    free, enough = is_free(attributes.get("auto_exposure")), is_steady_enough(attributes)
    if figures.drift is None and not enough:
        lacks("the drift of the camera", steady)
    if figures.flicker is None and (free or not enough):
        lacks("the flicker of the light", lock_exposure(filmed=figures.video is not None) if free else steady)
    if blown:
        lacks("what to expect of composites, as nearly all of the picture is clipped at white", larger)
    if attributes.get("pattern_error") is None:
        lacks("glare and what else the patterns don't explain", larger)
    if is_assumed(attributes):
        lacks("the noise, which is only assumed", "add constant frames of four levels, or several of each")
    halftones = "show half-tones, as the presets do"
    if not program.halftones[0].size:
        lacks("whether the monitor scaled the patterns", halftones)
    if (
        figures.camera.source == "given"
        and figures.camera.apart is None
        and not attributes["storage"]["black"]
    ):
        lacks("the camera's curve, which the capture states", halftones)
    if figures.monitor.source == "given" and _shows_greys(program):
        lacks(
            "the monitor's curve, which the capture states",
            'set the monitor\'s `"response": "unknown"` and show three grey levels',
        )
    if figures.video is not None and not attributes.get("border"):
        lacks(
            "the camera's exposure from frame to frame, as the film shows no border",
            "film the program with its border",
        )
    if not lacking:
        return None
    return Finding(
        name="unmeasured",
        level="warning",
        message=f"not measured: {'; '.join(lacking)}",
        remedy="; ".join(remedies),
    )


def is_blown(survey: dict[str, Any]) -> bool:
    """Whether nearly all of the picture is clipped at white, so that patterns say little about composites."""
    return bool(survey["white"]["clipped_high"] > BLOWN)


def is_assumed(attributes: dict[str, Any]) -> bool:
    """Whether the noise is only assumed."""
    return bool(attributes.get("assumed_noise") and not attributes.get("noise_of_patterns"))


def is_steady_enough(attributes: dict[str, Any]) -> bool:
    """Whether patterns show so little beside T and noise that no movement or flicker among it can show."""
    return beside_noise(attributes) < SHOWS


def lock_exposure(*, filmed: bool) -> str:
    """What to do about a camera whose exposure was not locked."""
    return "lock exposure and ISO before filming" if filmed else "set exposure and ISO by hand for all stills"


def _assumed(name: str, curve: CameraCurve) -> Finding:
    return Finding(
        name=f"{name}_curve",
        level="warning",
        message=f"the {name}'s curve is {_shape(curve)}, only assumed",
        remedy="state it in capture.json (`response`), show half-tones as the presets do, or take the constant frames "
        "in two exposures; RAW needs no curve",
    )


def _shows_greys(program: Program) -> bool:
    """Whether the monitor's curve makes a difference."""
    _, sent = program.constants
    return bool(not np.isin(sent, (0, 1)).all() or any(isinstance(part, Images) for part in program.parts))


def _dB(square: float) -> str:
    return f"{-10 * log10(square):.0f}"


def _shape(curve: CameraCurve) -> str:
    """A tone curve in words."""
    if isinstance(curve, str):
        return curve
    if isinstance(curve, tuple):
        red, green, blue = (100 * float(to_light(np.array(0.5, np.float32), own)) for own in curve)
        return (
            f"one of each channel's own: red has {red:.0f}, green {green:.0f} and blue {blue:.0f} % of the light at "
            "half of the range"
        )
    if isinstance(curve, Sampled):
        return f"one that gives {100 * curve.light[len(curve.light) // 2]:.0f} % of the light at half of the range"
    return f"a gamma of {curve.gamma:g}"
