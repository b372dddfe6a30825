"""How long a recovery of a capture will take, from a trial of each quality on some of its pixels."""

import time

import numpy as np
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.tone_curves import Curve
from workflows.ingest.trial.trial_recovery import Sample, recover_seen, see_sample
from workflows.programs.program import Program
from workflows.recovery.lobes.options import FAST, FINE
from workflows.recovery.sensing import Patterns

QUALITIES = {"fine": FINE, "fast": FAST}


def core_seconds(stack: Stack, sample: Sample, patterns: Patterns) -> dict[str, float] | None:
    """Seconds that one core takes to recover all pixels of a stack, by quality; None if there is too little contrast.

    Parameters
    ----------
    stack : Stack
        With its attributes after `find_steadiness`.
    sample : Sample
        As from `take_sample`. Some of its squares are tried.
    patterns : Patterns
        As from `find_steadiness`.

    Notes
    -----
    The time of a pixel depends on its glass: more lobes take longer, and fits start from those of neighbours. So some
    of the squares of `take_sample`, which are spread over the frame, are tried, with the shifts and gains that were
    found. Kernels are compiled by then: steadiness was measured with them. What counts is the time of this thread on
    its core: a trial takes half a second, in which other processes often have half of the core. Reading the frames and
    writing the matte are left out.
    """
    attributes = stack.attributes
    program = Program.model_validate(attributes["program"])
    monitor: Curve = TypeAdapter[Curve](Curve).validate_python(attributes["monitor_curve"])
    shifts, gains = np.zeros((stack.frames, 2)), np.zeros(stack.frames)
    if attributes["shifts"] is not None:
        shifts = np.array(attributes["shifts"])
    if attributes["gains"] is not None:
        gains = np.log(attributes["gains"])
    tried = sample.some_squares()
    seen, places = see_sample(stack, tried, shifts), tried.places.T
    share = float(np.count_nonzero(stack.mask()) / len(places))
    seconds = {}
    for name, options in QUALITIES.items():
        start = time.thread_time()
        if recover_seen(stack, program, monitor, patterns, seen, gains, options, places) is None:
            return None
        seconds[name] = round(share * (time.thread_time() - start), 2)
    return seconds
