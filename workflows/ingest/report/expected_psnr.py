"""The PSNR to expect of composites, before anything is recovered."""

from collections.abc import Sequence
from math import log10
from typing import Any, NamedTuple

import numpy as np

from workflows.ingest.light.stack_attributes import patterns_seen
from workflows.ingest.report.figures import Quality
from workflows.programs.parts import Bernoulli, Constant, Halftone
from workflows.programs.program import Program

UNLOCKED = 0.06
"""Exposures whose standard deviation is a larger share of their mean are not those of a locked camera."""

EXPOSURE_LEFT = 0.35
"""Share of the standard deviation of such exposures by which composites are off: what follows them is not exact."""
NOISE_KNOWN = 1.2
"""What is left of patterns may have so many times the variance of noise, and be nothing else."""
UNKNOWN_EXPOSURE = 0.3
"""Share by which composites are brighter or darker than the scene is to be shown, at most, if the exposure was free."""
BACKDROP = 1 / 3
"""Mean square of a backdrop's light, if all from black to white is as frequent."""


class _End(NamedTuple):
    """What the errors of composites are taken for at an end of the range, see the Notes of `expected`."""

    k: float
    c: float
    d: float
    a: float
    b: float
    others: float
    """dB by which composites are worse than patterns, without random ones."""
    model: float
    """Of the error of the model."""
    left: float
    """Of what is left of patterns."""
    in_colour: float
    """Of what is not explained, if patterns in colour lost detail."""


_LOW = _End(k=19.0, c=0.0093, d=0.9, a=0.45, b=1.2, others=3.0, model=1.0, left=1.5, in_colour=1.0)
_HIGH = _End(k=5.5, c=0.00014, d=0.6, a=0.00045, b=0.35, others=-5.0, model=0.5, left=0.25, in_colour=0.5)


def expected(program: Program, attributes: dict[str, Any]) -> Quality | None:
    """Predict the PSNR of composites from the noise, the contrast, and the program's patterns.

    Parameters
    ----------
    program : Program
    attributes : dict
        Of the stack, after `survey`.

    Returns
    -------
    Quality or None
        None if white is within the noise of black, if random patterns are still to be shown, or if the program has none
        and its patterns could not be recovered on trial.

    Notes
    -----
    The squared error is modelled as ``k s^2 / m + c rho^2 / m^d``. The first term is noise of standard deviation s in
    about k parameters of T, S and rho. The second is what m patterns leave undetermined, in proportion to the contrast
    rho. What no T explains of the patterns is not explained of a backdrop either, and is added, as is the detail of
    colours that frames have lost (`workflows.ingest.report.colour_detail`). If it is the patterns' own colours that
    lost it, the high end has half of this: where T is wide, it averages most of it. For the same reason the high end
    has half of the error of the model, and of not more than patterns differ from T and the noise: it was measured where
    they are all black or white. Of 88 captures in JPEG, 23 were more than 2 dB outside the range without it, most of
    frosted glass, and are 3 with it.

    If random patterns have offsets, m counts all patterns but the random ones without. Otherwise it counts all, and
    ``a rho^2 / n^b`` is added for n blocks along the monitor's shorter side in the finest grid: it is not known where
    in a block the light comes from, which costs clear glass most and frosted glass least.

    If the exposure was not locked, what follows it is not exact: half of the share `EXPOSURE_LEFT` of the standard
    deviation of the exposures is added at the high end, as a share of the light of a backdrop. At the low end it is
    `UNKNOWN_EXPOSURE`, since nobody knows at which exposure the scene is to be shown: in films of eight cameras,
    composites had 18 to 43 dB, and 26 to 49 after the best exposure, whatever the deviation.

    What is left of patterns, and is no noise, is movement that could not be corrected, dispersion, sharpening and much
    else, of which composites have a part: of 96 captures by drawn cameras, 16 were more than 2 dB below the range
    without it, and are 5 with it.

    Without random patterns, as of stripes alone, composites are about as far from the truth as patterns from what T
    predicts: of five captures by a real camera, none was more than 3.4 dB worse, where backdrops are finer than
    patterns, nor 7 dB better, where they are coarser.

    The constants are fitted to three traced scenes of 160 x 120 pixels (a clear ball, a dispersing solid and a frosted
    lens) and the mean of four backdrops (`tests.benchmarks.recovery.figures`): k, c and d from the presets of 128, 49
    and 25 patterns at one and four times the noise; a and b from grids without offsets of 24, 48, 96 and 384 blocks. Of
    139 captures by cameras as `tests.benchmarks.recovery.devices` has them and by drawn ones, 7 are more than 2 dB
    outside the range; of 15 of them that were made afterwards, 1. All 7 are below it, and 5 to 12 dB better after the
    best exposure and colours, which no capture tells.
    """
    survey, patterns, costs = attributes["survey"], patterns_seen(attributes), costs_of(program, attributes)
    rho, s2 = survey["contrast"], survey["deviation"] ** 2
    pattern_error, left = attributes.get("pattern_error"), left_of(program, attributes)
    lost_colours = program.in_colour and costs["lost_colour"] > 0
    counts, _ = np.histogram(np.unique(patterns), program.starts)
    shown = [
        (part, int(count))
        for part, count in zip(program.parts, counts, strict=True)
        if count and not isinstance(part, Constant | Halftone)
    ]
    random = [part for part, _ in shown if isinstance(part, Bernoulli)]
    if rho > 0 and pattern_error and not any(isinstance(part, Bernoulli) for part in program.parts):
        low, high = (-20 * log10(pattern_error) - end.others for end in (_LOW, _HIGH))
        return Quality(low=low, high=high, blocks=None)
    if rho <= survey["deviation"] or not random:
        return None
    fixed = not any(part.offset for part in random)
    measured = sum(count for part, count in shown if fixed or not isinstance(part, Bernoulli) or part.offset)
    blocks = max(min(part.columns, part.rows) for part in random) if fixed else None
    model = costs["model_error"], min(costs["model_error"], beside_noise(attributes))
    exposed = 0.0, 0.0
    if costs["auto_exposure"]:
        exposed = BACKDROP * (UNKNOWN_EXPOSURE * rho) ** 2, costs["auto_exposure"] / 4
    ends = []
    for end, of_model, of_exposure in zip((_LOW, _HIGH), model, exposed, strict=True):
        error = end.k * s2 / measured + end.c * rho**2 / measured**end.d
        error += (end.model * of_model + costs["lost_colour"]) * (end.in_colour if lost_colours else 1)
        error += of_exposure + end.left * left
        ends.append(-10 * log10(error if blocks is None else error + end.a * rho**2 / blocks**end.b))
    return Quality(low=ends[0], high=ends[1], blocks=blocks)


def model_error_of(attributes: dict[str, Any]) -> float:
    """The error of the model that a stack's measurements promise of composites, as a share of rho.

    See `workflows.ingest.trial.unexplained`; captures of earlier versions have no ``smooth_error``.
    """
    return float(attributes.get("smooth_error", attributes.get("model_error", 0.0)))


def beside_noise(attributes: dict[str, Any]) -> float:
    """The mean square of what patterns show beside T and noise; infinity if it is not known."""
    error = attributes.get("pattern_error")
    return np.inf if error is None else max(error**2 - attributes["survey"]["deviation"] ** 2, 0.0)


def left_of(program: Program, attributes: dict[str, Any]) -> float:
    """The mean square of what is left of patterns that neither noise nor the error of the model explains.

    It is 0 if it is not known, or due to patterns in colour, whose detail the frames have lost.
    """
    error = attributes.get("pattern_error")
    if error is None or (program.in_colour and attributes.get("half_colour")):
        return 0.0
    survey = attributes["survey"]
    known = NOISE_KNOWN * survey["deviation"] ** 2 + (model_error_of(attributes) * survey["contrast"]) ** 2
    return float(max(error**2 - known, 0.0))


def costs_of(program: Program, attributes: dict[str, Any]) -> dict[str, float]:
    """The mean square errors of composites by their causes, as far as these are known; see :func:`expected`.

    Returns
    -------
    dict
        ``noise``, at the low end; ``model_error``, ``lost_colour``, ``auto_exposure``.
    """
    survey, measured = attributes["survey"], np.isin(program.measured, patterns_seen(attributes)).sum()
    rho = survey["contrast"]
    return {
        "noise": _LOW.k * survey["deviation"] ** 2 / max(measured, 1),
        "model_error": (model_error_of(attributes) * rho) ** 2,
        "lost_colour": survey.get("lost_colour", 0.0),
        "auto_exposure": exposure_error(attributes.get("auto_exposure")) * rho**2,
    }


def exposure_error(exposures: Sequence[float] | None) -> float:
    """The mean square error of composites for exposures that were not locked, as a share of rho squared."""
    spread = float(np.log(exposures).std()) if exposures else 0.0
    return BACKDROP * (EXPOSURE_LEFT * spread) ** 2 if spread > UNLOCKED else 0.0
