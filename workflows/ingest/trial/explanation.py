"""A trial recovery of a sample of the pixels from frames that show their patterns, without local tone mapping."""

from typing import Any, NamedTuple

import numpy as np

from storage.layout.captures import Stack
from workflows.ingest.camera.border_exposure import BorderLight, BorderValues, is_free
from workflows.ingest.camera.calibration import calibrate
from workflows.ingest.camera.white_balance import fit_white_balance
from workflows.ingest.light.local_gain import local_gain
from workflows.ingest.light.stack_attributes import (
    exposures_of,
    look_up_of,
    monitor_curve_of,
    white_balance_of,
)
from workflows.ingest.pixel_sample import PixelSample, see_sample, take_sample
from workflows.ingest.trial.covered import find_covered
from workflows.ingest.trial.tone_mapping import find_tone_mapping
from workflows.ingest.trial.trial_recovery import Calibrated
from workflows.ingest.trial.unexplained import MEASURED, Unexplained, find_unexplained
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out
from workflows.recovery.sensing import Patterns

TONE_MAPPING_TURNS = 2
"""Turns in which local tone mapping is found, and corrected: T has explained some of it before it is."""
WHITE_BALANCE_TURNS, SETTLED = 8, 0.002
"""Turns, at most, in which the white balance is found and corrected: the camera's curve, black and white are measured
from frames of several. They end when no gain changes by a larger share."""


class Explained(NamedTuple):
    """What explains a sample.

    Attributes
    ----------
    capture : Calibrated
    light : Patterns
        The program's, by the monitor's curve, without glare.
    wide : PixelSample
        A sample of all that sees the monitor.
    unexplained : Unexplained
        The last recovery, and what it leaves.
    """

    capture: Calibrated
    light: Patterns
    wide: PixelSample
    unexplained: Unexplained


def explain(
    stack: Stack, program: Program, sample: PixelSample, border: BorderValues | None
) -> Explained | None:
    """Find how the white balance changed, the frames in which something covers a part of the object, and what T leaves
    unexplained without them.

    Returns
    -------
    Explained or None
        None if the sample has too little contrast, or every measurement of it is clipped.
    """
    # The bare monitor tells what a camera does better than glass, whose T explains some of it.
    wide = sample if stack.mask().all() else take_sample(stack, masked=False) or sample
    _follow_white_balance(stack, program, wide, border)
    found = _explain(stack, program, sample, wide, border)
    if found is not None and find_covered(
        found.capture, found.unexplained.patterns, sample, found.unexplained.recovered
    ):
        # All that was measured with them may be wrong.
        calibrate(stack, border)
        stack.annotate(noise_of_patterns=False)
        found = _explain(stack, program, sample, wide, border)
    return found


def _explain(
    stack: Stack, program: Program, sample: PixelSample, wide: PixelSample, border: BorderValues | None
) -> Explained | None:
    """Find what T leaves unexplained in a sample, local tone mapping first, by a wide one.

    Local tone mapping that only the sample tells is left out again if T leaves more with it than without.
    """
    at_rest, before = np.zeros((stack.frames, 3)), np.inf

    def recover() -> tuple[Calibrated, Patterns, dict[str, Any], Unexplained | None]:
        capture = Calibrated(stack, program, monitor_curve_of(stack.attributes))
        light = lay_out(program, capture.monitor, stack.images(), scaled=stack.attributes["scaled"])
        measured = {name: stack.attributes[name] for name in MEASURED}
        return capture, light, measured, find_unexplained(capture, light, wide, at_rest)

    capture, light, measured, found = recover()
    for _ in range(TONE_MAPPING_TURNS):
        if found is None:
            break
        of_border, left = _border_light(stack, border), found.rest.size()
        if of_border is None and left > before:
            # What the patterns don't explain, as of glass with many edges, has only looked like it.
            calibrate(stack, border)
            capture, light, measured, found = recover()
            break
        before = left
        mapped = find_tone_mapping(stack, found.rest, wide, stack.attributes["tone_mapping"], of_border)
        if mapped is None:
            break
        calibrate(stack, border, tone_mapping=mapped)
        capture, light, measured, found = recover()
    if wide is not sample:
        stack.annotate(**measured)
        found = find_unexplained(capture, light, sample, at_rest)
    return None if found is None else Explained(capture, light, wide, found)


def _follow_white_balance(
    stack: Stack, program: Program, sample: PixelSample, border: BorderValues | None
) -> None:
    """Find how the white balance changed, annotate the stack with it as ``white_balance``, and calibrate it again.

    Patterns in colour don't tell it.
    """
    if stack.channels == 1 or program.channels(stack.images()) > 1:
        return
    patterns = np.array(stack.attributes["patterns"])
    exposures = exposures_of(stack.attributes)[:, np.newaxis, np.newaxis]
    for _ in range(WHITE_BALANCE_TURNS):
        known = white_balance_of(stack.attributes)
        seen = see_sample(stack, sample, np.zeros((stack.frames, 2)))
        found = fit_white_balance(seen.values / exposures, seen.whole, patterns, program, known)
        if found is None or (known is not None and np.abs(found / known - 1).max() < SETTLED):
            return
        stack.annotate(white_balance=found.round(5).tolist())
        calibrate(stack, border)


def _border_light(stack: Stack, border: BorderValues | None) -> BorderLight | None:
    """The light of a film's border, if its exposure was locked.

    One that was not follows the patterns, as local tone mapping does, and errors of the curve hide the latter.
    """
    if border is None or is_free(stack.attributes["auto_exposure"]):
        return None
    return border.fit(look_up_of(stack), local_gain(stack), white_balance_of(stack.attributes))
