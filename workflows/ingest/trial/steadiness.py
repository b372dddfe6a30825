"""Measure the drift of the camera and the flicker of the light in every frame, by trial recoveries of some pixels."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.ingest.camera.border_exposure import BorderValues, is_free
from workflows.ingest.measured_light import black_patterns
from workflows.ingest.trial.explanation import explain
from workflows.ingest.trial.movement import smooth_path
from workflows.ingest.trial.trial_recovery import (
    FURTHEST,
    Doubles,
    PixelSample,
    Trial,
    measure_rest,
    try_recovery,
)
from workflows.ingest.trial.unexplained import find_unexplained
from workflows.ingest.trial.white_exposure import find_white_excess
from workflows.programs.program import Program
from workflows.recovery.sensing import Patterns

ROUNDS = 10
"""Rounds of measuring and correcting, at most."""
SETTLED = (0.003, 0.0005)
"""Rounds end when shifts, in pixels, and gains change less than this, root mean square."""
MIN_DRIFT, MIN_FLICKER = 0.01, 0.003
"""Drift (root mean square, pixels) and flicker (standard deviation of the gain) below these are not corrected."""
TRIFLE = 0.5
"""The first trial sees only part of a disturbance: more rounds follow if it finds this share of `MIN_DRIFT` or
`MIN_FLICKER`,"""
LOOK_AGAIN, SURE = 2.0, 4.0
"""and at least `LOOK_AGAIN` standard errors. In the end, what is below `SURE` standard errors is not corrected."""
LIMITS = np.array([FURTHEST, FURTHEST, 0.4])
"""Largest shifts, in pixels, and largest logarithm of the gain that are searched for."""
REST = 0.25
"""The last round may leave at most this share of what was found."""
EXPLAINED = np.array([2.4, 1.5])
"""Largest residuals with which shifts and gains are believed, in standard deviations of the noise."""
STALLED = 0.005
"""Rounds end, too, when two in succession lower the squared residual by less than this share: they wander."""
LEFT = 0.4
"""The squared residual may keep this share of its excess over noise. If it keeps more, the frames differ from what is
predicted in ways that only look like shifts and gains."""
NOTHING_LEFT = 0.1
"""An excess of the squared residual over noise that is as good as none."""
MEMORY = 4
"""Rounds before the last one from which the next is extrapolated."""
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
    `workflows.ingest.measured_light` does. Shifts are relative to the mean position of the patterns, gains to their
    median, or to a white frame if the exposure was free.

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
    frames are corrected, T is recovered again, and so on; each round extrapolates from the last few (Anderson
    acceleration). Constant frames have no structure to locate them by, and get the shift of the frames before and
    after. If the exposure was free, one gain of all patterns is found in place of each frame's
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

    References
    ----------
    H. F. Walker and P. Ni, Anderson acceleration for fixed-point iterations, SIAM J. Numer. Anal. 49, 2011.
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
    program = Program.model_validate(stack.attributes["program"])
    if sample is None:
        return None
    explained = explain(stack, program, sample, border)
    if explained is None:
        return None
    capture, light, wide, (at_first, through, _) = explained
    begin = np.zeros((stack.frames, 3))
    at_rest = measure_rest(capture, through, sample, begin, at_first)
    try_out = partial(try_recovery, capture, through, sample)
    patterns = np.array(stack.attributes["patterns"])
    shown = np.isin(patterns, program.measured)
    if np.count_nonzero(np.isfinite(at_rest.off[shown]).all(axis=1)) < MIN_FRAMES:
        return through
    first, has_black = at_rest, bool(np.isin(black_patterns(program), patterns).any())
    free = is_free(stack.attributes["auto_exposure"])
    if free:
        begin[shown, 2] = find_white_excess(capture, light, wide)
        first = try_out(begin) or at_rest
        # Most of what is lit is clipped: the gain of a frame is less exact than its exposure by the border.
        first = first._replace(off=first.off * [1, 1, 0])
    found = _search(try_out, begin, first, at_rest.residual, shown, has_black and not free)
    corrected = np.concatenate(
        [found.off[:, :2] * found.moves, (found.off if found.flickers else begin)[:, 2:]], axis=1
    )
    gains = np.exp(corrected[:, 2] - (0 if free else np.median(corrected[shown, 2])))
    figures: dict[str, Any] = {}
    if found.is_known:
        code = light.code[light.pyramid.starts[-2] :].reshape(-1, light.channels, program.measured.size)
        bright = code.mean(axis=(0, 1))[np.searchsorted(program.measured, patterns[shown])]
        figures = _figures(found, shown, bright)
        if free:
            figures["flicker"] = None
    stack.annotate(
        steadiness=figures,
        shifts=corrected[:, :2].round(4).tolist() if found.moves else None,
        gains=gains.round(5).tolist() if corrected[:, 2].any() else None,
    )
    if not corrected.any():
        return through
    again = find_unexplained(capture, light, sample, corrected)
    return again and again.patterns


class _Found(NamedTuple):
    """Shifts and logarithms of gains, (frames, 3), the trial that they are of, and what of them is to be corrected.

    Neither is known if the patterns don't explain what the frames show.
    """

    off: Doubles
    trial: Trial
    moves: bool
    flickers: bool
    is_known: bool


def _search(
    try_out: Callable[[Doubles], Trial | None],
    begin: Doubles,
    first: Trial,
    residual: float,
    shown: NDArray[np.bool_],
    with_gains: bool,
) -> _Found:
    """Find shifts, and gains if these are free, from a beginning, the trial of it, and the residual without either."""
    found, last = begin + _fill_gaps(first, shown), first
    moves = flickers = False
    believed = np.ones(2, bool)
    least = np.array([MIN_DRIFT, MIN_FLICKER])
    size, error = _sizes(found, first, shown)
    if ((size > TRIFLE * least) & (size > LOOK_AGAIN * error)).any():
        found, last, left = _settle(try_out, begin, first, shown, with_gains)
        size, error = _sizes(found, last, shown)
        there = (size >= least) & (size >= SURE * error)
        sure = there & (_sizes(left, last, shown)[0] <= REST * size) & _within(found, shown)
        believed = _believed(residual, last.residual)
        moves = bool(sure[0] and believed[0])
        # Movement that is not a common shift looks like flicker.
        flickers = bool(sure[1] and believed[1] and with_gains and (moves or not there[0]))
    if moves or flickers:
        return _Found(found, last, moves, flickers, is_known=True)
    is_known = last.residual <= EXPLAINED[0] and (last is first or bool(believed.any()))
    # The first trial underestimates, but later rounds may have diverged.
    return _Found(begin + _fill_gaps(first, shown), first, moves, flickers, is_known)


def _believed(before: float, after: float) -> NDArray[np.bool_]:
    """Whether shifts and gains are believed, by the residuals before and after they were taken out."""
    left = max(LEFT * (before**2 - 1), NOTHING_LEFT)
    believed: NDArray[np.bool_] = (after < EXPLAINED) & (after**2 - 1 <= left)
    return believed


def _settle(
    try_out: Callable[[Doubles], Trial | None],
    begin: Doubles,
    trial: Trial,
    shown: NDArray[np.bool_],
    with_gains: bool,
) -> tuple[Doubles, Trial, Doubles]:
    """Correct and measure again, from a beginning and the trial of it, until little is left; returns what was found,
    the trial of it, and what that left.

    Where more is left whatever is done, later rounds wander: then it is the round that explains the frames best.
    """
    scale, free = np.array([1, 1, SETTLED[0] / SETTLED[1]]), np.array([1, 1, int(with_gains)])
    state = begin
    states: list[Doubles] = []
    steps: list[Doubles] = []
    tried: list[tuple[Doubles, Trial]] = []
    least = [trial.residual**2]
    left = _fill_gaps(trial, shown) * free
    for _ in range(ROUNDS):
        states.append(state * scale)
        steps.append(left * scale)
        ahead = states[-1] + steps[-1]
        if len(steps) > 1:
            from_steps, from_states = (
                np.diff(np.array(kept[-MEMORY - 1 :]).reshape(-1, state.size), axis=0).T
                for kept in (steps, states)
            )
            share = np.linalg.lstsq(from_steps, steps[-1].ravel(), rcond=None)[0]
            ahead -= ((from_steps + from_states) @ share).reshape(state.shape)
        ahead /= scale
        ahead[:, :2] -= ahead[shown, :2].mean(axis=0)
        ahead = np.clip(ahead, -LIMITS, LIMITS)
        again = try_out(ahead)
        if again is None:
            break
        state, trial = ahead, again
        left = _fill_gaps(trial, shown) * free
        if _size(left[shown, :2]) < SETTLED[0] and _size(left[shown, 2:]) < SETTLED[1]:
            return state, trial, left
        tried.append((state, trial))
        least.append(min(least[-1], trial.residual**2))
        if len(tried) > 1 and least[-1] > (1 - STALLED) * least[-3]:
            break
    state, trial = min(tried, key=lambda one: one[1].residual, default=(state, trial))
    return state, trial, _fill_gaps(trial, shown) * free


def _fill_gaps(trial: Trial, shown: NDArray[np.bool_]) -> Doubles:
    """The shift and gain of each frame; missing shifts are interpolated from other frames, missing gains are 1.

    Shifts are those of a likely path, relative to the mean position of the patterns, gains to those of the constant
    frames.
    """
    filled = trial.off.copy()
    known = np.flatnonzero(shown & np.isfinite(filled).all(axis=1))
    path = smooth_path(trial.off[known, :2], trial.error[known, :2])
    for axis in range(2):
        filled[:, axis] = np.interp(np.arange(len(filled)), known, path[:, axis])
    filled[:, :2] -= filled[shown, :2].mean(axis=0)
    return np.nan_to_num(filled)


def _size(values: Doubles) -> float:
    """Root mean square of the lengths of rows."""
    return float(np.sqrt((values**2).sum(axis=1).mean()))


def _sizes(found: Doubles, trial: Trial, shown: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """Size of the drift and of the flicker, root mean square, and the standard errors of most frames."""
    error = trial.error[shown]
    size = np.array([_size(found[shown, :2]), found[shown, 2].std()])
    return size, np.array([_usual(error[:, :2]), _usual(error[:, 2:])])


def _usual(errors: Doubles) -> float:
    """The median length of rows without gaps."""
    return float(np.median(np.linalg.norm(errors[np.isfinite(errors).all(axis=1)], axis=1)))


def _within(found: Doubles, shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether shifts and gains are within `LIMITS`."""
    most = np.abs(found[shown]).max(axis=0) < LIMITS
    return np.array([most[:2].all(), most[2]])


def _figures(found: _Found, shown: NDArray[np.bool_], bright: Doubles) -> dict[str, Any]:
    """The figures of drift and flicker; of what is beyond the limits of the search, and so something else, None."""
    off, error = found.off, found.trial.error
    gain = np.exp(off[:, 2] - np.median(off[shown, 2]))
    drift = _drift(off[shown, :2], error[shown, :2]) | {"corrected": found.moves}
    flicker = _flicker(gain, error[:, 2], np.flatnonzero(shown), bright) | {"corrected": found.flickers}
    within = _within(off, shown)
    return {"drift": drift if within[0] else None, "flicker": flicker if within[1] else None}


def _drift(places: Doubles, error: Doubles) -> dict[str, Any]:
    angle = np.radians(np.arange(180))
    along = places @ np.stack([np.cos(angle), np.sin(angle)])
    return {
        "pixels": float(np.ptp(along, axis=0).max()),
        "error": _usual(error),
        "quarters": [part.mean(axis=0).round(3).tolist() for part in np.array_split(places, QUARTERS)],
    }


def _flicker(gain: Doubles, error: Doubles, frames: NDArray[np.intp], bright: Doubles) -> dict[str, Any]:
    """The figures of the gains of the frames of patterns, whose mean light is ``bright``."""
    off = gain[frames] - 1
    follows = np.corrcoef(gain[frames], bright)[0, 1] if off.any() and np.ptp(bright) else 0.0
    worst = int(np.argmax(np.abs(off)))
    return {
        "percent": float(100 * off.std()),
        "error": float(100 * _size(error[frames][np.isfinite(error[frames]), np.newaxis])),
        "worst_percent": float(100 * off[worst]),
        "worst_frame": int(frames[worst]),
        "follows": float(follows),
        "frames": len(frames),
    }
