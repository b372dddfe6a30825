"""What a recovery of each quality takes, and how far it will be from the truth, by trials on some pixels."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numba.core.event import install_recorder
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.ingest.light.stack_attributes import monitor_curve_of, program_of
from workflows.ingest.pixel_sample import PixelSample, Seen, see_sample
from workflows.ingest.trial.trial_recovery import Calibrated, RecoveredSample, recover_seen
from workflows.programs.parts import Bernoulli
from workflows.programs.program import Program
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.interval import HELD_OUT, Interval, fit_interval, local_contrast
from workflows.recovery.lobes.options import FAST, FINE
from workflows.recovery.sensing import Patterns

QUALITIES = {"fine": FINE, "fast": FAST}
MOST_PREDICTED = 20
"""Patterns that are predicted, at most: their contrast takes time too."""
PIXELS = 320
"""Pixels, at most, from which patterns are held out."""
MOST_LEVERAGE = 0.9
"""Of a pattern: its errors are made at most ten times as large."""
COLOURED = 0.7
"""How much narrower the intervals of JPEG and HEIC stills are if the patterns are in colour: these are stored at half
the resolution, so that what is held out is farther from the truth than T, which is found from many of them."""
SHARPENED = 1.35
"""How much wider a film's intervals are: cameras sharpen films by an amount that can't be measured, since patterns are
sharpened as the glass is."""


class QualityTrial(NamedTuple):
    """What is to be expected of a recovery.

    Attributes
    ----------
    seconds : float
        That one core takes for all pixels.
    interval : Interval or None
        None if the patterns can't tell, or too little was seen of those that are held out.
    """

    seconds: float
    interval: Interval | None


class _Prediction(NamedTuple):
    """What a recovery predicts of k patterns.

    Attributes
    ----------
    light : (n, k, 3) float32
        As the pixels see it.
    contrast : (n, k, 3) float32
        That of the pattern as it arrives, times rho squared.
    """

    light: NDArray[np.float32]
    contrast: NDArray[np.float32]


def try_qualities(stack: Stack, sample: PixelSample, patterns: Patterns) -> dict[str, QualityTrial] | None:
    """Recover some pixels by each quality, with all patterns and without some; None if there is too little contrast.

    Parameters
    ----------
    stack : Stack
        With its attributes after `find_steadiness`.
    sample : PixelSample
        As from `take_sample`. Some of its squares are tried.
    patterns : Patterns
        As from `find_steadiness`.

    Notes
    -----
    The time of a pixel depends on its glass: more lobes take longer, and fits start from those of neighbours. So some
    of the squares of `take_sample`, which are spread over the frame, are tried, with the shifts and gains that were
    found. What counts is the time of this thread on its core: a trial takes half a second, in which other processes
    often have half of the core. Reading the frames and writing the matte are left out.
    """
    attributes = stack.attributes
    program = program_of(attributes)
    capture = Calibrated(stack, program, monitor_curve_of(attributes))
    shifts, gains = np.zeros((stack.frames, 2)), np.zeros(stack.frames)
    if attributes["shifts"] is not None:
        shifts = np.array(attributes["shifts"])
    if attributes["gains"] is not None:
        gains = np.log(attributes["gains"])
    tried = sample.some_squares()
    seen, places = see_sample(stack, tried, shifts), tried.places.T
    share = sample.wanted / len(places)
    seconds: dict[str, float] = {}
    for name, options in QUALITIES.items():
        taken = _seconds(partial(recover_seen, capture, patterns, seen, gains, options, places))
        if taken is None:
            return None
        seconds[name] = round(share * taken, 2)
    random = [part for part in program.parts if isinstance(part, Bernoulli)]
    # On fixed grids, no pattern tells where in a block the light comes from, but backdrops do.
    can_tell = not random or any(part.offset for part in random)
    intervals: dict[str, Interval | None] = {}
    if can_tell:
        # The leverage of stripes is a mean over pixels, and fewer tell too little of it.
        spread = (sample.thinned(PIXELS) if random else sample).blocks()
        intervals = _intervals(capture, patterns, spread, see_sample(stack, spread, shifts), gains)
    return {name: QualityTrial(taken, intervals.get(name)) for name, taken in seconds.items()}


def _seconds(recover: Callable[[], RecoveredSample | None]) -> float | None:
    """The time that a recovery takes this thread, without that of compiling kernels; None if it has no result."""
    with install_recorder("numba:compile") as compiled:
        start = time.thread_time()
        result = recover()
        taken = time.thread_time() - start
    if result is None:
        return None
    return _seconds(recover) if compiled.buffer else taken


def _intervals(
    capture: Calibrated, patterns: Patterns, sample: PixelSample, seen: Seen, gains: NDArray[np.float64]
) -> dict[str, Interval | None]:
    """The interval of each quality, from what recoveries of a sample predict of patterns that they have not seen.

    Some random patterns are held out of each square. Each of a few stripes tells what no other does: without it,
    predictions would be far worse than with it. So where there are no random patterns, all are used, and the recovery
    is repeated with a disturbance of each. The share of it that returns in the prediction is the pattern's leverage:
    without the pattern, the error would be 1 / (1 - leverage) times as large, exactly so of a linear fit.
    """
    chosen = _random_patterns(capture.program)
    is_held_out = len(chosen) > 0
    chosen = chosen if is_held_out else np.arange(patterns.count)
    step = -(-len(chosen) // MOST_PREDICTED)
    chosen = chosen[step // 2 :: step]
    square, places = np.unique(sample.chosen[0], return_inverse=True)[1], sample.places.T
    tested = np.ones((len(square), len(chosen)), bool)
    held_out = None
    if is_held_out:
        groups = -(-len(chosen) * HELD_OUT // patterns.count)
        tested = square[:, np.newaxis] % groups == np.arange(len(chosen)) % groups
        held_out = np.zeros((len(square), patterns.count), bool)
        held_out[:, chosen] = tested
    tries = [seen] if is_held_out else [seen, _disturbed(capture.stack, seen, square)]
    recovered: dict[str, list[RecoveredSample]] = {}
    for name, options in QUALITIES.items():
        tried = [
            recover_seen(capture, patterns, each, gains, options, places, square, held_out) for each in tries
        ]
        recovered[name] = [each for each in tried if each is not None]
    predictions = iter(_predict(patterns, [each for made in recovered.values() for each in made], chosen))
    intervals: dict[str, Interval | None] = {}
    for name, made in recovered.items():
        predicted = [next(predictions) for _ in made]
        if len(made) < len(tries):
            continue
        shown = capture.program.measured[chosen]
        error = made[0].light.values[:, shown] - predicted[0].light
        if not is_held_out:
            leverage = np.clip(_leverage(made, predicted, shown), 0, MOST_LEVERAGE)
            error /= 1 - leverage[:, np.newaxis]
        share = 0.0 if held_out is None else float(held_out.mean())
        intervals[name] = _interval(capture, made[0], error, predicted[0], tested, chosen, share)
    return intervals


def _leverage(
    made: Sequence[RecoveredSample], predicted: Sequence[_Prediction], shown: NDArray[np.intp]
) -> NDArray[np.float32]:
    """The share of the disturbance of each pattern that returns in the prediction, (k,), in the mean of all pixels."""
    (plain, disturbed), (before, after) = made, predicted
    disturbance = disturbed.light.values[:, shown] - plain.light.values[:, shown]
    usable = plain.light.usable[:, shown] & disturbed.light.usable[:, shown]
    returned = (disturbance * (after.light - before.light)).sum(axis=(0, 2), where=usable)
    whole = (disturbance**2).sum(axis=(0, 2), where=usable)
    leverage: NDArray[np.float32] = returned / np.maximum(whole, 1e-12)
    return leverage


def _random_patterns(program: Program) -> NDArray[np.intp]:
    """The random patterns, as numbers among those measured."""
    are_random = [isinstance(part, Bernoulli) for part in program.parts for _ in range(part.count)]
    found: NDArray[np.intp] = np.flatnonzero(np.array(are_random)[program.measured])
    return found


def _disturbed(stack: Stack, seen: Seen, square: NDArray[np.intp]) -> Seen:
    """What is seen, with frames that are too bright or too dark by their noise, the same for all of a square."""
    frames, squares = len(seen.values), int(square.max()) + 1
    bits = np.random.PCG64(0).random_raw(frames * squares).reshape(frames, squares) & 1
    sign = (2 * bits.astype(np.float32) - 1)[:, square, np.newaxis]
    noise = NoiseModel(**stack.attributes["noise"])
    deviation = np.sqrt(noise.variance(seen.values)).astype(np.float32)
    return seen._replace(values=seen.values + sign * deviation)


def _interval(
    capture: Calibrated,
    found: RecoveredSample,
    error: NDArray[np.float32],
    predicted: _Prediction,
    tested: NDArray[np.bool_],
    chosen: NDArray[np.intp],
    held_out: float,
) -> Interval | None:
    """The interval by the errors of what a recovery predicts of some patterns; None if too little was seen of these."""
    stack, program, _ = capture
    attributes, channels, photometry = stack.attributes, stack.channels, found.photometry
    noise, model_error = NoiseModel(**attributes["noise"]), float(attributes["model_error"])
    shown = program.measured[chosen]
    variance = noise.variance(predicted.light) / np.maximum(found.light.worth[:, shown], 1e-6)
    variance += (model_error * photometry.rho[:, np.newaxis]) ** 2
    known = found.light.usable[:, shown] & found.alive[:, np.newaxis] & tested[:, :, np.newaxis]
    known[:, :, channels:] = False
    if not known.any():
        return None
    fitted = fit_interval(
        error[known],
        predicted.contrast[known],
        variance[known],
        float(np.median(photometry.rho[found.alive])),
        noise,
        float(np.median(found.light.worth[:, program.measured].sum(axis=1))),
        (model_error, float(attributes["smooth_error"])),
        held_out,
    )
    if program.in_colour and attributes.get("half_colour"):
        fitted = fitted.wider(COLOURED)
    return fitted.wider(SHARPENED) if attributes.get("video") else fitted


def _predict(
    patterns: Patterns, recovered: list[RecoveredSample], chosen: NDArray[np.intp]
) -> list[_Prediction]:
    """Predict some patterns by each recovery. The contrast of a pattern is worked out once for all of them."""
    pyramid = patterns.pyramid
    columns, rows = pyramid.grids[0]
    code = patterns.code.reshape(len(patterns.code), patterns.channels, patterns.count)
    made = []
    for sample in recovered:
        shape = len(sample.photometry.rho), len(chosen), 3
        made.append(_Prediction(np.empty(shape, np.float32), np.empty(shape, np.float32)))
    for n, pattern in enumerate(chosen):
        light = code[:, :, pattern].astype(np.float32) / np.float32(255)
        square = pyramid.light((light[: columns * rows] ** 2).reshape(rows, columns, -1))
        around = local_contrast(pyramid, light, square)
        light, around = (np.broadcast_to(part, (len(code), 3)) for part in (light, around))
        for sample, predicted in zip(recovered, made, strict=True):
            S, rho = sample.photometry.S, sample.photometry.rho
            predicted.light[:, n] = S + rho * sample.transport.apply(light)
            if sample.stray is not None:
                predicted.light[:, n] += sample.stray[:, pattern]
            predicted.contrast[:, n] = rho**2 * sample.transport.apply(around)
    return made
