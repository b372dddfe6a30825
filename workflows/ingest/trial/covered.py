"""Stills in which something covers a part of the object, by what a trial recovery predicts of them."""

import numpy as np

from workflows.ingest.light.stack_attributes import exposures_of, odd_frames
from workflows.ingest.pixel_sample import Doubles, PixelSample
from workflows.ingest.trial.frame_order import MOST_ODD
from workflows.ingest.trial.trial_recovery import Calibrated, RecoveredSample, predict, recover_seen
from workflows.programs.parts import Bernoulli
from workflows.recovery.sensing import Patterns

OFF, UNUSUAL = 0.1, 6.0
"""A square is off in a frame if its light differs from what is predicted by more than this share of white's, and by so
many times what is usual."""
COVERED, CLEAR = 0.2, 2.0
"""A square was covered if it differs by more than this share from what is predicted without the frame, and by so many
times as much as those of other frames: drift, flicker and changing light of the room make many frames differ."""
SQUARES = 2
"""Squares that must be."""
MIN_VALUES = 4
"""Values of a square that its light is the mean of, at least."""
LIT, MOST = 0.2, 0.5
"""Light of the pattern in a square, as a share of white's, from which on it tells the exposure of a frame, and by what
share this differs at most: where more is missing, most of the object is covered."""


def find_covered(
    capture: Calibrated, patterns: Patterns, sample: PixelSample, found: RecoveredSample
) -> bool:
    """Find the stills in which something covers a part of the object, and add them to ``odd_frames`` of the stack.

    Parameters
    ----------
    capture : Calibrated
    patterns : Patterns
        With the glare that was found.
    sample : PixelSample
    found : RecoveredSample
        Its recovery from all frames.

    Returns
    -------
    bool
        Whether there are any.

    Notes
    -----
    A hand over a tenth of the object leaves a thumbnail like its pattern, but pixels can't be explained where it was: T
    is bent to it, so that other frames are off too. The frame that is off most is left out, and the sample recovered
    again, until no frame is off, or the one left out is hardly farther from what a T predicts that knows nothing of it.
    What moves, or is sharpened, makes some pixels brighter and others darker: the mean of a square is hardly off. What
    all squares have in common is the exposure.
    """
    stack, program, _ = capture
    is_random = any(isinstance(part, Bernoulli) for part in program.parts)
    # The frames of a film were compared when they were matched, and what jolts it would be taken for a hand. In another
    # order no frame is like its pattern. Without random patterns, none tells what another one does.
    if "video" in stack.attributes or stack.attributes["order"] or not is_random:
        return False
    before, most = odd_frames(stack.attributes), int(MOST_ODD * stack.frames)
    held: list[int] = []
    again: RecoveredSample | None = found
    while again is not None:
        off = np.abs(_off(capture, patterns, sample, again))
        far = np.sort(np.nan_to_num(off), axis=1)[:, -SQUARES]
        worst = _worst(off, before + held)
        if worst is None or (held and far[held[-1]] <= COVERED):
            least = max(COVERED, CLEAR * float(np.delete(far, held).max()))
            held = [frame for frame in held if far[frame] > least]
            stack.annotate(odd_frames=sorted(before + held))
            return bool(held)
        if len(held) == most:  # so many are no single accidents
            break
        held.append(worst)
        stack.annotate(odd_frames=sorted(before + held))
        again = recover_seen(capture, patterns, found.seen, np.zeros(stack.frames))
    stack.annotate(odd_frames=sorted(before))
    return False


def _worst(off: Doubles, left_out: list[int]) -> int | None:
    """The frame that is off most, but for those that are left out; None if too few squares are off in all."""
    is_off = off > max(OFF, UNUSUAL * float(np.nanmedian(off)))
    is_off[left_out] = False
    if np.count_nonzero(is_off) < SQUARES:
        return None
    return int(np.argmax(np.where(is_off, off**2, 0).sum(axis=1)))


def _off(capture: Calibrated, patterns: Patterns, sample: PixelSample, found: RecoveredSample) -> Doubles:
    """How far the light of each square is from what is predicted, as a share of white's, (frames, squares) float64.

    Frames of constants and half-tones, and squares of too few values, are NaN.
    """
    stack, program, _ = capture
    attributes, photometry, alive, seen = stack.attributes, found.photometry, found.alive, found.seen
    exposures = exposures_of(attributes)
    apart = np.linalg.inv(np.array(attributes["crosstalk"])).astype(np.float32).T
    at = {pattern: n for n, pattern in enumerate(program.measured.tolist())}
    predicted = (predict(found.transport, patterns) + 1) / 2
    rho = np.where(alive, photometry.rho, 1)
    square, squares = sample.chosen[0], sample.codes.shape[1]
    off = np.full((stack.frames, squares), np.nan)
    for n, pattern in enumerate(attributes["patterns"]):
        if pattern not in at:
            continue
        value = np.broadcast_to(seen.values[n] / exposures[n], alive.shape) @ apart
        lit = predicted[:, :, at[pattern]]
        good = alive & np.broadcast_to(seen.whole[n], alive.shape)
        rest = np.where(good, (value - photometry.S) / rho - lit, 0)
        sums = [np.bincount(square, of.sum(axis=1), squares) for of in (good, np.where(good, lit, 0), rest)]
        enough = sums[0] >= MIN_VALUES
        light, more = (of / np.maximum(sums[0], 1) for of in sums[1:])
        bright = enough & (light > LIT)
        gain = np.clip(np.median(more[bright] / light[bright]), -MOST, MOST) if bright.any() else 0.0
        off[n] = np.where(enough, more - gain * light, np.nan)
    return off
