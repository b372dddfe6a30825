"""Measure by how much the border of a film overestimates the exposure of a white monitor, by trial recoveries."""

from functools import partial

import numpy as np

from workflows.ingest.pixel_sample import PixelSample
from workflows.ingest.trial.trial_recovery import Calibrated, try_recovery
from workflows.ingest.trial.unexplained import MEASURED, find_unexplained
from workflows.recovery.sensing import Patterns

MOST = 0.4
"""Largest excess that is searched for,"""
EXACT = 0.01
"""and how exactly it is found."""


def find_white_excess(capture: Calibrated, light: Patterns, sample: PixelSample) -> float:
    """The logarithm of the factor by which the border overestimates the exposure of white, if that was free.

    It is the gain of all patterns, in units of white's.

    Parameters
    ----------
    capture : Calibrated
    light : Patterns
        The program's, without glare.
    sample : PixelSample
        Of all that sees the monitor.

    Returns
    -------
    float
        From -0.4 to 0.4; 0 if nothing can be tried. The stack's attributes are as they were.

    Notes
    -----
    Such a camera exposes white for about two thirds of the time of patterns. Then the lit parts of the border are
    clipped in nearly all patterns, and exposures are those of its edges: onto these lens, denoising and sharpening
    spread light of the white monitor beside them, so that white seems to be exposed for longer, by 15 % in the film of
    a phone. But what pixels show of a pattern that they see as all white is S + rho, and the rows of T add up to 1. So
    it is the gain with which a trial recovery explains the patterns best. Pixels that see the bare monitor tell it
    better than those of glass alone, whose rows are free to explain the patterns otherwise: a mask does not count.
    """
    from scipy.optimize import minimize_scalar  # takes half a second to import

    stack, program, _ = capture
    measured = {name: stack.attributes[name] for name in MEASURED}
    state, shown = np.zeros((stack.frames, 3)), np.isin(stack.attributes["patterns"], program.measured)
    excess, found = 0.0, find_unexplained(capture, light, sample, state)
    if found is not None:
        try_out = partial(try_recovery, capture, found.patterns, sample)

        def left(gain: float) -> float:
            state[shown, 2] = gain
            trial = try_out(state)
            return np.inf if trial is None else trial.residual

        best = minimize_scalar(left, bounds=(-MOST, MOST), method="bounded", options={"xatol": EXACT})
        excess = float(best.x) if np.isfinite(best.fun) else 0.0
    stack.annotate(**measured)
    return excess
