"""How still the camera was and how even the light: of every frame, from a trial recovery of some pixels."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.tone_curves import Curve
from workflows.ingest.measured_light import black_patterns
from workflows.ingest.report.trial_recovery import FURTHEST, Doubles, Trial, look, sampled
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out

ROUNDS = 10
"""Of measuring and taking out, at most."""
SETTLED = (0.003, 0.0005)
"""Pixels of shift, and gain: rounds end when the last one changed less, root mean square."""
LEAST_DRIFT, LEAST_FLICKER = 0.01, 0.003
"""Root mean square in pixels, and deviation of the gain, from which they are corrected."""
TRIFLE = 0.5
"""Of these, from which a first look, which sees but part of them, is followed by others."""
LOOK_AGAIN, SURE = 2.0, 4.0
"""Standard errors from which it is, and from which in the end there is anything."""
MOST = np.array([FURTHEST, FURTHEST, 0.4])
"""Pixels of shift, and of gain its logarithm, that are looked for."""
REST = 0.25
"""What the last round leaves, at most, of what was found."""
EXPLAINED = np.array([2.4, 1.5])
"""Residuals, in the noise's deviations and of 3 at most, up to which shifts and gains are believed."""
MEMORY = 4
"""Rounds before the last that the next one is told from."""
LEAST_FRAMES = 8
"""Of patterns, for anything to be told."""
QUARTERS = 4
"""Of the capture: their mean places are told."""


def find_steadiness(stack: Stack) -> None:
    """Find each frame's shift and gain, and annotate the stack with them.

    ``steadiness`` says what was found; it is None if too few pixels tell anything, and empty if the patterns don't
    explain what the frames show. Its ``drift`` and ``flicker`` are None where they are too large to be either.
    ``shifts`` (frames, 2), x and y in pixels, and ``gains`` (frames) are None unless they are to be taken out, which
    `workflows.ingest.measured_light` does. Shifts are about the patterns' mean place, gains about their median.

    Notes
    -----
    T is recovered for some pixels as if all was still. What frame n then shows otherwise than predicted is fitted by
    ``d_n . grad C + a_n rho T L`` over all of them (Huber's weights), its picture's shift -d_n and gain 1 + a_n.
    T has taken part of that for its own, above all of a slow drift, since coarse and fine patterns are shown one after
    another; so frames are corrected, T is recovered again, and so on, each round from what the last few say
    together (Anderson's acceleration). Constants have no structure of their own to be placed by: they get the
    shift of the frames before and after.

    What it is worth: PSNR in dB of composites, uncorrected and corrected, of a ball of 4,300 pixels with a blur of half
    a pixel and the noise of `Scene.film`.

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

    The true shifts do better by 1 dB at most. Flicker of 0.3 % costs nothing. Undisturbed captures are found still to
    0.002 pixels and even to 0.04 %. Pictures that no lens has blurred alias: there a drift of 0.3 pixels is not
    sure, and stays.

    References
    ----------
    H. F. Walker and P. Ni, Anderson acceleration for fixed-point iterations, SIAM J. Numer. Anal. 49, 2011.
    """
    stack.annotate(steadiness=None, shifts=None, gains=None)  # an ingest may be tried again
    program = Program.model_validate(stack.attributes["program"])
    sample = sampled(stack)
    if sample is None:
        return
    monitor: Curve = TypeAdapter[Curve](Curve).validate_python(stack.attributes["monitor_curve"])
    try_out = partial(look, stack, program, monitor, lay_out(program, monitor, stack.images()), sample)
    patterns = np.array(stack.attributes["patterns"])
    shown = np.isin(patterns, program.measured)
    first = try_out(np.zeros((stack.frames, 3)))
    if first is None or np.count_nonzero(np.isfinite(first.off[shown]).all(axis=1)) < LEAST_FRAMES:
        return
    found, last = _filled(first.off, shown), first
    moves = flickers = False
    least = np.array([LEAST_DRIFT, LEAST_FLICKER])
    size, error = _sizes(found, first, shown)
    if ((size > TRIFLE * least) & (size > LOOK_AGAIN * error)).any():
        has_black = bool(np.isin(black_patterns(program), patterns).any())
        found, last, left = _settle(try_out, first, shown, has_black)
        size, error = _sizes(found, last, shown)
        there = (size >= least) & (size >= SURE * error)
        sure = there & (_sizes(left, last, shown)[0] <= REST * size) & _within(found, shown)
        believed = last.residual < np.minimum(EXPLAINED, first.residual)
        moves = bool(sure[0] and believed[0])
        # What moved otherwise than that looks like flicker.
        flickers = bool(sure[1] and believed[1] and has_black and (moves or not there[0]))
    if not moves and not flickers and last.residual > EXPLAINED[0]:
        stack.annotate(steadiness={})
        return
    if not moves and not flickers:
        # A first look sees part of what there is, but further ones may lead astray.
        found, last = _filled(first.off, shown), first
    gain = np.exp(found[:, 2] - np.median(found[shown, 2]))
    drift = _drift(found[shown, :2], last.error[shown, :2]) | {"corrected": moves}
    flicker = _flicker(gain, last.error[:, 2], np.flatnonzero(shown)) | {"corrected": flickers}
    # What is beyond all that is looked for is something else.
    told = _within(found, shown)
    stack.annotate(
        steadiness={"drift": drift if told[0] else None, "flicker": flicker if told[1] else None},
        **({"shifts": found[:, :2].round(4).tolist()} if moves else {}),
        **({"gains": gain.round(5).tolist()} if flickers else {}),
    )


def _settle(
    try_out: Callable[[Doubles], Trial | None], trial: Trial, shown: NDArray[np.bool_], has_black: bool
) -> tuple[Doubles, Trial, Doubles]:
    """Take out what is found and look again, until little is left: what was found, the last trial, and what it left."""
    scale = np.array([1, 1, SETTLED[0] / SETTLED[1]])
    state = np.zeros_like(trial.off)
    states: list[Doubles] = []
    steps: list[Doubles] = []
    for _ in range(ROUNDS):
        step = _filled(trial.off, shown) * ([1, 1, 1] if has_black else [1, 1, 0])
        states.append(state * scale)
        steps.append(step * scale)
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
        ahead = np.clip(ahead, -MOST, MOST)
        again = try_out(ahead)
        if again is None:
            break
        state, trial = ahead, again
        left = _filled(trial.off, shown)
        if _size(left[shown, :2]) < SETTLED[0] and _size(left[shown, 2:]) < SETTLED[1]:
            break
    return state, trial, _filled(trial.off, shown)


def _filled(off: Doubles, shown: NDArray[np.bool_]) -> Doubles:
    """What each frame is off by: shifts that aren't told from the frames before and after, gains are then 1.

    About the mean place of the patterns; gains are against the constants'.
    """
    filled = off.copy()
    told = np.flatnonzero(shown & np.isfinite(off).all(axis=1))
    for axis in range(2):
        filled[:, axis] = np.interp(np.arange(len(off)), told, off[told, axis])
    filled[:, :2] -= filled[shown, :2].mean(axis=0)
    return np.nan_to_num(filled)


def _size(values: Doubles) -> float:
    """Root mean square length of rows."""
    return float(np.sqrt((values**2).sum(axis=1).mean()))


def _sizes(found: Doubles, trial: Trial, shown: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """How far the frames lie apart in place and gain, root mean square, and the standard errors of that."""
    error = trial.error[shown & np.isfinite(trial.error).all(axis=1)]
    size = np.array([_size(found[shown, :2]), found[shown, 2].std()])
    return size, np.array([_size(error[:, :2]), _size(error[:, 2:])])


def _within(found: Doubles, shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether places and gains are within what is looked for."""
    most = np.abs(found[shown]).max(axis=0) < MOST
    return np.array([most[:2].all(), most[2]])


def _drift(places: Doubles, error: Doubles) -> dict[str, Any]:
    angle = np.radians(np.arange(180))
    along = places @ np.stack([np.cos(angle), np.sin(angle)])
    return {
        "pixels": float(np.ptp(along, axis=0).max()),
        "error": _size(error[np.isfinite(error).all(axis=1)]),
        "quarters": [part.mean(axis=0).round(3).tolist() for part in np.array_split(places, QUARTERS)],
    }


def _flicker(gain: Doubles, error: Doubles, frames: NDArray[np.intp]) -> dict[str, Any]:
    off = gain[frames] - 1
    worst = int(np.argmax(np.abs(off)))
    return {
        "percent": float(100 * off.std()),
        "error": float(100 * _size(error[frames][np.isfinite(error[frames]), np.newaxis])),
        "worst_percent": float(100 * off[worst]),
        "worst_frame": int(frames[worst]),
        "frames": len(frames),
    }
