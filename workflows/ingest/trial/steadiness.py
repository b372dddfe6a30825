"""Measure the drift of the camera and the flicker of the light in every frame, by trial recoveries of some pixels."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.ingest.camera.border_exposure import BorderValues, is_free
from workflows.ingest.light.stack_attributes import program_of
from workflows.ingest.pixel_sample import Doubles, PixelSample
from workflows.ingest.trial.explanation import explain
from workflows.ingest.trial.search import Found, Search, are_within, size_of, usual_error
from workflows.ingest.trial.trial_recovery import measure_rest, try_recovery
from workflows.ingest.trial.unexplained import find_unexplained
from workflows.ingest.trial.white_exposure import find_white_excess
from workflows.programs.program import Program
from workflows.recovery.sensing import Patterns

MIN_FRAMES = 8
"""Frames of patterns that are needed to measure anything."""
QUARTERS = 4
"""Parts of the capture whose mean positions are reported."""


def find_steadiness(
    stack: Stack, sample: PixelSample | None, border: BorderValues | None = None
) -> Patterns | None:
    """Find the shift and the gain of each frame, and annotate the stack with them.

    ``steadiness`` says what was found. It is None if there are too few pixels to measure, and empty if the patterns
    don't explain what the frames show. Its ``drift`` and ``flicker`` are None if they are too large to be either.
    ``shifts`` (frames, 2), x and y in pixels, and ``gains`` (frames) are None unless they are to be corrected, which
    `workflows.ingest.light.measured_light` does. Shifts are relative to the mean position of the patterns, gains to
    their median, or to a white frame if the exposure was free.

    Parameters
    ----------
    stack : Stack
        With its attributes after `calibrate`.
    sample : PixelSample, optional
        As from `take_sample`.
    border : BorderValues, optional
        Of a film with a border.

    Returns
    -------
    Patterns or None
        The program's, with the glare that was found; None if there are too few pixels, or too little contrast.

    Notes
    -----
    T is recovered for some pixels as if nothing had moved. The difference between frame n and its prediction is then
    fitted by ``d_n . grad C + a_n rho T L`` over these pixels, with Huber weights; -d_n is the shift and 1 + a_n the
    gain of the frame. Shifts are smoothed to a likely path (`workflows.ingest.trial.movement`). T has absorbed part of
    a disturbance, most of all of a slow drift, since coarse and fine patterns are shown one after another. So the
    frames are corrected, T is recovered again, and so on; each round extrapolates from the last few
    (`workflows.ingest.trial.search`). Constant frames have no structure to locate them by, and get the shift of the
    frames before and after. If the exposure was free, one gain of all patterns is found in place of each frame's
    (`workflows.ingest.trial.white_exposure`).

    PSNR of composites in dB, uncorrected and corrected, for a ball of 4,300 pixels with a blur of half a pixel and the
    noise of `Scene.film`:

    ==================  ============  ============
    frames              default       quick
    ==================  ============  ============
    undisturbed         55.0          53.4
    drift of 0.1 px     52.4 -> 54.7  52.1 -> 53.4
    drift of 0.3 px     42.8 -> 53.4  45.6 -> 52.9
    drift of 1 px       32.9 -> 46.7  33.9 -> 49.2
    a jump of 0.5 px    34.5 -> 46.7  35.4 -> 48.9
    flicker of 1 %      54.3 -> 54.7
    flicker of 3 %      48.9 -> 54.5
    ==================  ============  ============

    The true shifts are better by 1 dB at most. Flicker of 0.3 % costs nothing. Undisturbed captures are found to be
    still to 0.002 pixels and even to 0.04 %. Pictures without any optical blur alias: a drift of 0.3 pixels is then not
    certain, and is not corrected.
    """
    stack.annotate(  # a retried ingest must not find old ones
        steadiness=None,
        shifts=None,
        gains=None,
        glare=None,
        model_error=0.0,
        smooth_error=0.0,
        pattern_error=None,
        noise_of_patterns=False,
    )
    program = program_of(stack.attributes)
    if sample is None:
        return None
    explained = explain(stack, program, sample, border)
    if explained is None:
        return None
    capture, light, wide, (at_first, through, _) = explained
    patterns = np.array(stack.attributes["patterns"])
    shown = np.isin(patterns, program.measured)
    begin = np.zeros((stack.frames, 3))
    at_rest = measure_rest(capture, through, sample, begin, at_first)
    if np.count_nonzero(np.isfinite(at_rest.off[shown]).all(axis=1)) < MIN_FRAMES:
        return through
    try_out = partial(try_recovery, capture, through, sample)
    first, has_black = at_rest, bool(np.isin(program.black, patterns).any())
    free = is_free(stack.attributes["auto_exposure"])
    if free:
        begin[shown, 2] = find_white_excess(capture, light, wide)
        first = try_out(begin) or at_rest
        # Most of what is lit is clipped: the gain of a frame is less exact than its exposure by the border.
        first = first._replace(off=first.off * [1, 1, 0])
    found = Search(try_out, begin, shown, has_black and not free).run(first, at_rest.residual)
    corrected = found.to_correct(begin)
    gains = np.exp(corrected[:, 2] - (0 if free else np.median(corrected[shown, 2])))
    white = np.isin(patterns, program.ends()[1]) & np.isfinite(found.trial.off[:, 2])
    bright = _brightness(light, program, patterns[shown])
    figures = _figures(found, shown, white, bright) if found.is_known else {}
    stack.annotate(
        steadiness=figures | {"flicker": None} if free and figures else figures,
        shifts=corrected[:, :2].round(4).tolist() if found.moves else None,
        gains=gains.round(5).tolist() if corrected[:, 2].any() else None,
    )
    if not corrected.any():
        return through
    again = find_unexplained(capture, light, sample, corrected)
    return again and again.patterns


def _brightness(light: Patterns, program: Program, patterns: NDArray[np.int_]) -> Doubles:
    """The mean light of some of the patterns that are measured."""
    code = light.code[light.pyramid.starts[-2] :].reshape(-1, light.channels, program.measured.size)
    mean: Doubles = code.mean(axis=(0, 1))[np.searchsorted(program.measured, patterns)]
    return mean


def _figures(
    found: Found, shown: NDArray[np.bool_], white: NDArray[np.bool_], bright: Doubles
) -> dict[str, Any]:
    """The figures of drift and flicker; of what is beyond the limits of the search, and so something else, None."""
    off, error = found.off, found.trial.error
    gain = np.exp(off[:, 2] - np.median(off[shown, 2]))
    drift = _drift(off[shown, :2], error[shown, :2]) | {"corrected": found.moves}
    flicker = _flicker(gain, error[:, 2], np.flatnonzero(shown), bright) | {"corrected": found.flickers}
    if found.flickers and white.any():
        flicker["white_percent"] = float(100 * (gain[white].mean() - 1))
    within = are_within(off, shown)
    return {"drift": drift if within[0] else None, "flicker": flicker if within[1] else None}


def _drift(places: Doubles, error: Doubles) -> dict[str, Any]:
    angle = np.radians(np.arange(180))
    along = places @ np.stack([np.cos(angle), np.sin(angle)])
    return {
        "pixels": float(np.ptp(along, axis=0).max()),
        "error": usual_error(error),
        "quarters": [part.mean(axis=0).round(3).tolist() for part in np.array_split(places, QUARTERS)],
    }


def _flicker(gain: Doubles, error: Doubles, frames: NDArray[np.intp], bright: Doubles) -> dict[str, Any]:
    """The figures of the gains of the frames of patterns, whose mean light is ``bright``."""
    off = gain[frames] - 1
    follows = np.corrcoef(gain[frames], bright)[0, 1] if off.any() and np.ptp(bright) else 0.0
    worst = int(np.argmax(np.abs(off)))
    return {
        "percent": float(100 * off.std()),
        "error": float(100 * size_of(error[frames][np.isfinite(error[frames]), np.newaxis])),
        "worst_percent": float(100 * off[worst]),
        "worst_frame": int(frames[worst]),
        "follows": float(follows),
        "frames": len(frames),
    }
