"""How long a recovery of a capture will take, from a trial of each quality on some of its pixels."""

import time

import numpy as np
from pydantic import TypeAdapter

from storage.layout.captures import Stack
from workflows.images.tone_curves import Curve
from workflows.ingest.trial.trial_recovery import Sample, recover_sample
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
        The pixels that are tried, as from `take_sample`.
    patterns : Patterns
        As from `find_steadiness`.

    Notes
    -----
    The time of a pixel depends on its glass: more lobes take longer. So the pixels of `take_sample`, which are spread
    over the frame, are tried, with the shifts and gains that were found. Kernels are compiled by then: steadiness was
    measured with them. What counts is the time of this thread on its core: a trial takes half a second, in which other
    processes often have half of the core. Reading the frames and writing the matte are left out.
    """
    attributes = stack.attributes
    program = Program.model_validate(attributes["program"])
    monitor: Curve = TypeAdapter[Curve](Curve).validate_python(attributes["monitor_curve"])
    state = np.zeros((stack.frames, 3))
    if attributes["shifts"] is not None:
        state[:, :2] = attributes["shifts"]
    if attributes["gains"] is not None:
        state[:, 2] = np.log(attributes["gains"])
    share = float(np.count_nonzero(stack.mask()) / len(sample.chosen[0]))
    seconds = {}
    for name, options in QUALITIES.items():
        start = time.thread_time()
        if recover_sample(stack, program, monitor, patterns, sample, state, options) is None:
            return None
        seconds[name] = round(share * (time.thread_time() - start), 2)
    return seconds
