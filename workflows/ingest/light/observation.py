"""What frames of constant patterns say of S and rho, and what else than T the other frames show."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.images.tone_curves import Curve, to_light
from workflows.ingest.light.stack_attributes import patterns_seen
from workflows.programs.border import border_light
from workflows.programs.program import Program
from workflows.recovery.camera.clipped import bound_clipped
from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry, fit_photometry
from workflows.recovery.normalise import Conditions

Floats = NDArray[np.float32]


def conditions_of(stack: Stack, program: Program) -> Conditions:
    """What else than T the frames of a capture show, as far as its ingest found it."""
    attributes = stack.attributes
    return Conditions(
        stack.channels == 1,
        stray_light(attributes, program),
        attributes.get("model_error", 0.0),
    )


def stray_light(attributes: dict[str, Any], program: Program) -> Floats:
    """What changes with the patterns' numbers but is none of their light: the border of a film, seen in the glass.

    Parameters
    ----------
    attributes : dict
        Of the stack.
    program : Program

    Returns
    -------
    (s, m + 2) float32
        A row of ones, then one row for each bit of the border, of mean 0; columns as of
        :class:`~workflows.recovery.lobes.footprint.PatternCodes`.

    Notes
    -----
    S and S + rho are the ends of a line that is fitted to the constant frames, so the border's light in them is the
    same linear function of its light in these frames.
    """
    shown = program.measured
    if not attributes.get("border"):
        return np.ones((1, shown.size + 2), np.float32)
    border = border_light(range(program.count))
    numbers, sent = constants_of(attributes, program)
    slope = np.stack([np.ones(len(numbers)), sent.mean(axis=1)], axis=1)
    ends = np.array([[1, 0], [1, 1]]) @ np.linalg.pinv(slope)
    rows = np.concatenate([border[:, shown], border[:, numbers] @ ends.T.astype(np.float32)], axis=1)
    return np.concatenate([np.ones((1, rows.shape[1]), np.float32), rows])


def constants_of(attributes: dict[str, Any], program: Program) -> tuple[NDArray[np.intp], Floats]:
    """The constant patterns that S and rho are fitted to, and the values sent to the monitor in each.

    Beside a border they are the grey ones, if there are two levels: its bits differ between the frames that are black
    to one channel and those that are to another, so that `stray_light` would be another in each.
    """
    numbers, sent = program.constants_among(attributes["patterns"])
    grey = np.ptp(sent, axis=1) == 0
    if attributes.get("border") and np.ptp(sent[grey, :1]) > 0:
        return numbers[grey], sent[grey]
    return numbers, sent


def observe(
    light: PatternLight, attributes: dict[str, Any], program: Program, monitor: Curve
) -> tuple[Photometry, PatternLight]:
    """Fit S and rho to what pixels saw of constant patterns, and bound what is clipped of those that are measured."""
    noise = NoiseModel(**attributes["noise"])
    numbers, sent = constants_of(attributes, program)
    photometry = fit_photometry(light.of_patterns(numbers), to_light(sent, monitor), noise)
    shown = program.measured
    filmed = np.isin(shown, patterns_seen(attributes))
    return photometry, bound_clipped(light.of_patterns(shown), filmed, photometry, noise)
