"""What the figures of a capture mean, and what to do about them, in words."""

from math import floor, log2
from typing import Any

import numpy as np

from workflows.ingest.camera.border_exposure import is_free
from workflows.ingest.report.expected_psnr import costs_of, model_error_of
from workflows.ingest.report.figures import LEVELS, Drift, Figures, Finding, Flicker, graded
from workflows.ingest.report.frame_findings import constants, frames, named, odd_frames, order
from workflows.ingest.report.limits import (
    camera_curve,
    is_assumed,
    is_steady_enough,
    lock_exposure,
    lost_colour,
    monitor_curve,
    quality,
    unexplained,
    unmeasured,
)
from workflows.programs.parts import Bernoulli
from workflows.programs.program import Program

SURE = 4.0
"""A drift or flicker is real from so many standard errors on."""
DIMMED = 3.0
"""Per cent by which white frames differ from white in patterns from which on they, and half-tones, tell less."""
FOLLOWS = -0.25
"""Correlation of frames' light with their patterns' own below which the camera brightens dark pictures."""


def findings(figures: Figures, program: Program, attributes: dict[str, Any]) -> list[Finding]:
    """All findings about a capture, from its figures, its program and the attributes of its stack.

    The worst come first. Of one level, those come first that cost most, then, where the cost is not known, those that
    cost most when measured (`tests.benchmarks.recovery.devices`): exposure, the camera's own processing, movement,
    scaled patterns, curves, glare, colours.
    """
    survey, storage, costs = attributes["survey"], attributes["storage"], costs_of(program, attributes)
    files = attributes.get("files")  # missing from films, and captures of earlier versions
    if attributes.get("order"):  # what else would be found means nothing
        return [order(**attributes["order"], files=files), frames(figures)]
    white = figures.flicker.white_percent if figures.flicker else 0.0
    found: list[Finding | None] = [
        odd_frames(attributes.get("odd_frames", []), files),
        # What followed the camera's own exposure is corrected.
        constants(None if attributes.get("auto_exposure") else attributes.get("constants_apart"), files),
        _exposure(figures) if storage["bounded"] else None,
        _black(figures.clipping.black, linear=storage["black"] > 0),
        _auto_exposure(
            attributes.get("auto_exposure"), costs["auto_exposure"], filmed=figures.video is not None
        ),
        _white_balance(attributes.get("white_balance")),
        _tone_mapping(attributes.get("tone_mapping")),
        _steadiness(attributes),
        _drift(figures.drift),
        _scaling(program, scaled=attributes.get("scaled", False)),
        _white_apart(white),
        camera_curve(figures.camera, linear=storage["black"] > 0, dimmed=abs(white) >= DIMMED),
        monitor_curve(figures.monitor, program),
        _glare(attributes.get("glare")),
        _crosstalk(figures, program, grey=survey.get("grey", False)),
        unexplained(costs["model_error"], model_error_of(attributes)),
        lost_colour(program, costs["lost_colour"], half_colour=attributes.get("half_colour", False)),
        _noise(figures, attributes, costs["noise"]),
        _flicker(figures.flicker, files, mapped=bool(attributes.get("tone_mapping"))),
        frames(figures),
        quality(
            figures.quality,
            random=any(isinstance(part, Bernoulli) for part in program.parts),
            exposed=costs["auto_exposure"] > 0,
        ),
        unmeasured(figures, program, attributes),
    ]
    return sorted(filter(None, found), key=lambda one: (-LEVELS.index(one.level), -(one.cost or 0.0)))


def _exposure(figures: Figures) -> Finding:
    clipped, reach = figures.clipping.white, figures.white_reaches
    level = graded(clipped, 0.002, 0.05)
    if level != "good":
        less = "a third of a stop" if clipped < 0.01 else "half a stop" if clipped < 0.05 else "a stop"
        return Finding(
            name="exposure",
            level=level,
            message=f"the white frame is clipped in {100 * clipped:.1f} % of the pixels",
            remedy=f"expose {less} less, or add frames of a shorter exposure",
        )
    level = graded(-reach, -0.5, -0.15)
    share = f"{100 * reach:.0f} % of the range"
    if level == "good":
        return Finding(name="exposure", level=level, message=f"white reaches {share}")
    stops = floor(2 * log2(0.9 / max(reach, 0.01))) / 2
    more = "half a stop" if stops <= 0.5 else "a stop" if stops == 1 else f"{stops:g} stops"
    return Finding(
        name="exposure",
        level=level,
        message=f"white reaches only {share}",
        remedy=f"expose {more} more",
    )


def _black(clipped: float, *, linear: bool) -> Finding:
    """Black that is clipped; values of linear light have room below it."""
    return Finding(
        name="black",
        level="good" if linear else graded(clipped, 0.05, 0.3),
        message=f"the black frame is clipped in {100 * clipped:.1f} % of the pixels",
        remedy="raise the camera's black level, let a little light into the room, or shoot RAW: values below black "
        "are lost, and dark glass becomes too bright",
    )


def _steadiness(attributes: dict[str, Any]) -> Finding | None:
    found, free = attributes.get("steadiness"), is_free(attributes.get("auto_exposure"))
    if found is None or (found.get("drift") and (found.get("flicker") or free)):
        return None
    if is_steady_enough(attributes):
        return Finding(
            name="steadiness",
            level="good",
            message="neither the camera moved nor the light flickered by so much that it shows",
        )
    return Finding(
        name="steadiness",
        level="warning",
        message="the frames differ from what the patterns explain in ways that are neither a movement of the "
        "camera nor a flicker of the light, so these can't be measured",
        remedy="switch HDR, sharpening and noise reduction of the camera off, or shoot RAW; check that the frames "
        "show the patterns that capture.json names, and that neither camera nor glass moved by more than three "
        "pixels",
    )


def _drift(drift: Drift | None) -> Finding | None:
    if drift is None:
        return None
    # A corrected drift leaves a small rest; a drift within its own error is none.
    limits = (0.5, 2.0) if drift.corrected else (0.1, 0.5)
    level = graded(drift.pixels if drift.corrected or drift.pixels > SURE * drift.error else 0.0, *limits)
    found = f"the camera moved by {drift.pixels:.2f} pixels (a frame is located to {drift.error:.3f})"
    return Finding(
        name="drift",
        level=level,
        message=found + (": recovery shifts the frames back" if drift.corrected else ""),
        remedy="fix camera, glass and monitor better, use a remote release, and film again: "
        + (
            "so large a drift is corrected only in part"
            if drift.corrected
            else "no common shift of the frames explains it, so it is not corrected"
        ),
    )


def _tone_mapping(found: dict[str, float] | None) -> Finding | None:
    """Local tone mapping that is not certain is not reported: it is left out of recovery too."""
    if not found:
        return None
    percent = 100 * found["power"] * found["spread"]
    return Finding(
        name="tone_mapping",
        level=graded(percent, 1.0, 10.0),
        message=f"the camera brightens what is dark around a place and darkens what is bright, by {percent:.1f} % "
        "between patterns, as local tone mapping and HDR do: recovery corrects it",
        remedy="switch HDR and every enhancement of the camera off, or shoot RAW",
    )


def _flicker(flicker: Flicker | None, files: list[str] | None, *, mapped: bool) -> Finding | None:
    if flicker is None:
        return None
    limits = (2.0, 10.0) if flicker.corrected else (0.5, 2.0)
    level = graded(flicker.percent if flicker.percent > SURE * flicker.error else 0.0, *limits)
    if level != "good" and flicker.follows < FOLLOWS and not mapped:
        return Finding(
            name="tone_mapping",
            level=level,
            message=f"the camera brightens dark pictures and darkens bright ones, by {flicker.percent:.1f} % "
            "between patterns, as local tone mapping and HDR do"
            + (": recovery corrects what all of a frame has in common" if flicker.corrected else ""),
            remedy="switch HDR and every enhancement of the camera off, or shoot RAW",
        )
    return Finding(
        name="flicker",
        level=level,
        message=f"the light varies by {flicker.percent:.2f} % between frames, by {flicker.worst_percent:+.1f} % in "
        f"frame {named([flicker.worst_frame], files)}"
        + (": recovery corrects it" if flicker.corrected else ""),
        remedy="switch automatic exposure and the monitor's dimming off, leave the light of the room as it is, let "
        "the monitor warm up, and expose for whole periods of its refresh"
        + (
            ": so much is corrected only in part"
            if flicker.corrected
            else ": it is not corrected, because it is not certain, or no frame is black"
        ),
    )


def _white_apart(percent: float) -> Finding | None:
    """White frames that are darker, or brighter, than what is white in patterns."""
    if abs(percent) < DIMMED:
        return None
    return Finding(
        name="white",
        level=graded(abs(percent), DIMMED, 25.0),
        message=f"a white monitor differs by {percent:+.0f} % from what is white in patterns, as when a monitor "
        "limits its brightness, or exposure is not locked: recovery corrects it, and composites are exposed as "
        "patterns were",
        remedy="lock exposure and ISO, make the monitor darker, and switch its dimming off: the camera's curve "
        "can't be measured by half-tones that are dimmed too",
    )


def _auto_exposure(exposed: list[float] | None, cost: float, *, filmed: bool) -> Finding | None:
    if exposed is None:
        return None
    usual = float(np.median(exposed))
    most = max(max(exposed) / usual - 1, 1 - min(exposed) / usual)
    level = graded(most, 0.03, 0.25)
    return Finding(
        name="auto_exposure",
        level=level,
        message=f"the camera's exposure changed by up to {100 * most:.0f} % from pattern to pattern, "
        + ("as the border shows" if filmed else "as its files state")
        + ": recovery follows it, and composites are exposed as white was",
        cost=cost or None,
        remedy=lock_exposure(filmed=filmed)
        + (
            ": so large a change is followed only in part, and hides the camera's curve"
            if level == "bad"
            else ""
        ),
    )


def _white_balance(gains: list[list[float]] | None) -> Finding | None:
    """A white balance that hardly changed is not reported: recovery does not follow it either."""
    if not gains:
        return None
    most = float((np.max(gains, axis=0) / np.min(gains, axis=0)).max()) - 1
    return Finding(
        name="white_balance",
        level="warning",
        message=f"the camera's white balance changed by {100 * most:.0f} % while the patterns were shown: recovery "
        "follows it, and composites have the one that it began with",
        remedy="lock white balance before the first frame",
    )


def _glare(shares: list[float] | None) -> Finding | None:
    """Glare below 1 % is not reported: it is left out of recovery too."""
    if not shares:
        return None
    return Finding(
        name="glare",
        level=graded(sum(shares), 0.03, 0.3),
        message=f"veiling glare: {100 * sum(shares):.0f} % of the light comes from around the place that a pixel "
        "sees, scattered in the lens, the room or the glass. Composites have it too",
        remedy="clean the lens, darken the room, and keep bright things beside the monitor out of the picture",
    )


def _noise(figures: Figures, attributes: dict[str, Any], cost: float) -> Finding | None:
    survey = attributes["survey"]
    ratio = survey["contrast"] / survey["deviation"] if survey["deviation"] else 0.0
    if ratio <= 1:
        return Finding(
            name="noise",
            level="bad",
            message="the white frame is no brighter than the black one: the frames do not see the monitor",
            remedy="take the cap off the lens, switch the monitor on, and see that it fills the picture behind the "
            "object",
        )
    level = graded(-ratio, -25, -8)
    if level == "good" and is_assumed(attributes):
        return None
    return Finding(
        name="noise",
        level=level,
        cost=cost or None,
        message=f"noise of {figures.noise.black:.1f} grey levels of 8 bits at black, {figures.noise.full:.1f} at full "
        f"scale; white minus black is {ratio:.0f} times that of a pixel between them",
        remedy="expose longer at a lower ISO, take several frames of each pattern, make the monitor brighter or the "
        "room darker",
    )


def _crosstalk(figures: Figures, program: Program, *, grey: bool) -> Finding:
    between = float(np.abs(np.array(figures.crosstalk) - np.eye(3)).max())
    _, sent = program.constants
    measured = np.linalg.matrix_rank(np.concatenate([np.ones((len(sent), 1)), sent], axis=1)) == 4
    if measured:
        text = f"the camera's channels see up to {100 * between:.1f} % of the monitor's other colours: it is corrected"
        return Finding(name="crosstalk", level=graded(between, 0.3, 0.7), message=text)
    return Finding(
        name="crosstalk",
        level="good" if grey else "warning",
        message="a grey camera sees no colours"
        if grey
        else "the program does not show red, green and blue one at a time, so how much the camera's channels see of "
        "the other colours is not measured, and not corrected",
        remedy="add constant frames of red, green and blue, as the presets do",
    )


def _scaling(program: Program, *, scaled: bool) -> Finding | None:
    if not program.halftones[0].size:
        return None
    if not scaled:
        return Finding(name="scaling", level="good", message="the monitor showed the patterns pixel by pixel")
    return Finding(
        name="scaling",
        level="warning",
        message="the monitor showed the patterns at another size than they were made for, as their half-tones "
        "tell: recovery corrects it",
        remedy="set the browser's zoom to 100 % (Ctrl+0 or ⌘0), or play the film at its own size, and make the "
        "program for the monitor's size",
    )
