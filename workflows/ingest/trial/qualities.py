"""What a recovery of each quality takes, and how far it will be from the truth, by trials on some pixels."""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numba.core.event import install_recorder
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.ingest.light.measured_light import monitor_curve_of
from workflows.ingest.pixel_sample import PixelSample, see_sample
from workflows.ingest.trial.trial_recovery import Calibrated, RecoveredSample, recover_seen
from workflows.programs.parts import Bernoulli
from workflows.programs.program import Program
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.interval import HELD_OUT, Interval, fit_interval, local_contrast
from workflows.recovery.lobes.options import FAST, FINE
from workflows.recovery.sensing import Patterns

QUALITIES = {"fine": FINE, "fast": FAST}
MOST_HELD_OUT = 10
"""Patterns that are predicted, about: their contrast takes time too."""
PIXELS = 320
"""Pixels, at most, that are recovered without them."""
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
    program = Program.model_validate(attributes["program"])
    capture = Calibrated(stack, program, monitor_curve_of(attributes))
    shifts, gains = np.zeros((stack.frames, 2)), np.zeros(stack.frames)
    if attributes["shifts"] is not None:
        shifts = np.array(attributes["shifts"])
    if attributes["gains"] is not None:
        gains = np.log(attributes["gains"])
    tried = sample.some_squares()
    seen, places = see_sample(stack, tried, shifts), tried.places.T
    # For an interval, pixels from all over the glass count for more than the neighbours that a recovery starts from.
    spread = see_sample(stack, sample.thinned(PIXELS), shifts)
    share = sample.wanted / len(places)
    random = [part for part in program.parts if isinstance(part, Bernoulli)]
    # Each of a few stripes tells what no other does: without it, predictions would be far worse than with it.
    step = max(HELD_OUT if random else 1, patterns.count // MOST_HELD_OUT)
    chosen = np.arange(step // 2, patterns.count, step)
    held_out = chosen if random else ()
    # On fixed grids, no pattern tells where in a block the light comes from, but backdrops do.
    can_tell = not random or any(part.offset for part in random)
    seconds: dict[str, float] = {}
    without: dict[str, RecoveredSample] = {}
    for name, options in QUALITIES.items():
        taken = _seconds(partial(recover_seen, capture, patterns, seen, gains, options, places))
        if taken is None:
            return None
        seconds[name] = round(share * taken, 2)
        if can_tell:
            found = recover_seen(capture, patterns, spread, gains, options, held_out=held_out)
            without |= {name: found} if found else {}
    predictions = _predict(patterns, list(without.values()), chosen) if without else []
    intervals = {
        name: _interval(capture, found, *prediction, chosen)
        for (name, found), prediction in zip(without.items(), predictions, strict=True)
    }
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


def _interval(
    capture: Calibrated,
    found: RecoveredSample,
    predicted: NDArray[np.float32],
    contrast: NDArray[np.float32],
    chosen: NDArray[np.intp],
) -> Interval | None:
    """The interval by what a recovery predicts of some patterns; None if too little of these was seen."""
    stack, program, _ = capture
    attributes, channels, photometry = stack.attributes, stack.channels, found.photometry
    noise, model_error = NoiseModel(**attributes["noise"]), float(attributes["model_error"])
    shown = program.measured[chosen]
    light, worth = found.light.values[:, shown], found.light.worth[:, shown]
    if found.stray is not None:
        predicted = predicted + found.stray[:, chosen]
    variance = noise.variance(predicted) / np.maximum(worth, 1e-6)
    variance += (model_error * photometry.rho[:, np.newaxis]) ** 2
    known = found.light.usable[:, shown] & found.alive[:, np.newaxis]
    known[:, :, channels:] = False
    if not known.any():
        return None
    fitted = fit_interval(
        (light - predicted)[known],
        contrast[known],
        variance[known],
        float(np.median(photometry.rho[found.alive])),
        noise,
        float(np.median(found.light.worth[:, program.measured].sum(axis=1))),
        (model_error, float(attributes["smooth_error"])),
    )
    if program.in_colour and attributes.get("half_colour"):
        fitted = fitted.wider(COLOURED)
    return fitted.wider(SHARPENED) if attributes.get("video") else fitted


def _predict(
    patterns: Patterns, found: list[RecoveredSample], chosen: NDArray[np.intp]
) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Some patterns as the pixels see them, and rho squared times their contrast as it arrives, (n, k, 3) each.

    The contrast of a pattern is worked out once for all recoveries.
    """
    pyramid = patterns.pyramid
    columns, rows = pyramid.grids[0]
    code = patterns.code.reshape(len(patterns.code), patterns.channels, patterns.count)
    made = []
    for sample in found:
        shape = len(sample.photometry.rho), len(chosen), 3
        made.append((np.empty(shape, np.float32), np.empty(shape, np.float32)))
    for n, pattern in enumerate(chosen):
        light = code[:, :, pattern].astype(np.float32) / np.float32(255)
        square = pyramid.light((light[: columns * rows] ** 2).reshape(rows, columns, -1))
        around = local_contrast(pyramid, light, square)
        light, around = (np.broadcast_to(part, (len(code), 3)) for part in (light, around))
        for sample, (predicted, contrast) in zip(found, made, strict=True):
            S, rho = sample.photometry.S, sample.photometry.rho
            predicted[:, n] = S + rho * sample.transport.apply(light)
            contrast[:, n] = rho**2 * sample.transport.apply(around)
    return made
