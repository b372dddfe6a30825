"""The PSNR to expect of composites, before anything is recovered."""

from math import log10
from typing import Any

from workflows.ingest.report.figures import Quality
from workflows.programs.program import Bernoulli, Constant, Program

_NOISE = (19.0, 0.040), (5.5, 0.0044)  # k and c at the low and the high end
_FIXED_GRIDS = (0.45, 1.2), (0.00045, 0.35)  # a and b at the low and the high end


def expected(program: Program, survey: dict[str, Any], model_error: float) -> Quality | None:
    """Predict the PSNR of composites from the noise, the contrast, and the program's patterns.

    Parameters
    ----------
    program : Program
    survey : dict
        See `workflows.ingest.report.survey`.
    model_error : float
        See `workflows.ingest.report.unexplained`, as a share of rho.

    Returns
    -------
    Quality or None
        None if no pixel sees light, or the program has no random patterns: others have not been measured.

    Notes
    -----
    The squared error is modelled as ``k s^2 / m + c rho^2 / m^1.2``. The first term is noise of standard deviation s in
    about k parameters of T, S and rho. The second is what m patterns leave undetermined, in proportion to the contrast
    rho. What no T explains of the patterns is not explained of a backdrop either, and is added. If random patterns have
    offsets, m counts all patterns but the random ones without. Otherwise it counts all, and ``a rho^2 / n^b`` is added
    for n blocks along the monitor's shorter side in the finest grid: it is not known where in a block the light comes
    from, which costs clear glass most and frosted glass least.

    The constants are fitted to three traced scenes of 160 x 120 pixels (a clear ball, a dispersing solid and a frosted
    lens) and the mean of four backdrops (`tests.benchmarks.recovery.figures`): k and c from the presets of 128, 49 and
    25 patterns at one and four times the noise; a and b from grids without offsets of 24, 48, 96 and 384 blocks. Of 33
    captures measured, with the presets `default`, `quick`, `sketch`, `paper-250` and others, none is more than 0.6 dB
    below the range and none more than 2.5 dB above it; 20 of them were used in the fit. Other glass, and captures with
    warnings in their report, may be below.
    """
    rho, s2 = survey["contrast"], survey["deviation"] ** 2
    unexplained = (model_error * rho) ** 2
    shown = [part for part in program.parts if not isinstance(part, Constant)]
    random = [part for part in shown if isinstance(part, Bernoulli)]
    if rho <= 0 or not random:
        return None
    informative = [part for part in shown if not isinstance(part, Bernoulli) or part.offset]
    fixed = not any(part.offset for part in random)
    patterns = sum(part.count for part in (shown if fixed else informative))
    blocks = max(min(part.columns, part.rows) for part in random) if fixed else None
    ends = []
    for (k, c), (a, b) in zip(_NOISE, _FIXED_GRIDS, strict=True):
        error = k * s2 / patterns + c * rho**2 / patterns**1.2 + unexplained
        ends.append(-10 * log10(error if blocks is None else error + a * rho**2 / blocks**b))
    return Quality(low=ends[0], high=ends[1], blocks=blocks)
