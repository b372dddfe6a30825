"""What composites of a capture may be expected to be worth, before anything is recovered."""

from math import log10
from typing import Any

from workflows.ingest.report.figures import Quality
from workflows.programs.program import Bernoulli, Constant, Program

_MOVING = (19.0, 0.040), (5.5, 0.0044)
_STILL = (0.45, 1.2), (0.00045, 0.35)


def expected(program: Program, survey: dict[str, Any]) -> Quality | None:
    """PSNR of composites to expect, from the noise, the contrast, and the program's patterns.

    Parameters
    ----------
    program : Program
    survey : dict
        See `workflows.ingest.report.survey`.

    Returns
    -------
    Quality or None
        None if no pixel sees light, or the program has no random patterns: of others nothing has been measured.

    Notes
    -----
    The squared error is modelled as ``k s^2 / m + c rho^2 / m^1.2``: noise of the deviation s goes into some k
    parameters of T, S and rho; what the m patterns did not ask is the rest, in proportion to the contrast rho. If
    random patterns have offsets, m counts all but the random ones without. Otherwise it counts all, and
    ``a rho^2 / n^b`` comes on top, for n blocks along the monitor's shorter side in the finest grid: where in a block
    the light comes from is not told, which costs clear glass most and frosted glass least.

    The constants are fitted to three traced scenes of 160 x 120 pixels, a clear ball, a dispersing solid and a frosted
    lens, and the mean of four backdrops (`tests.benchmarks.recovery.figures`): k and c from the presets of 128, 49 and
    25 patterns, and the noise once and four times; a and b from grids without offsets of 24, 48, 96 and 384 blocks.
    Of the 33 captures measured, presets `default`, `quick`, `sketch`, `paper-250` and others, none is more than 0.6 dB
    below the range and none more than 2.5 dB above it; the fit knew 20 of them. Other glass, and what a report warns
    of, may well be below.
    """
    rho, s2 = survey["contrast"], survey["deviation"] ** 2
    shown = [part for part in program.parts if not isinstance(part, Constant)]
    random = [part for part in shown if isinstance(part, Bernoulli)]
    if rho <= 0 or not random:
        return None
    asking = [part for part in shown if not isinstance(part, Bernoulli) or part.offset]
    still = not any(part.offset for part in random)
    patterns = sum(part.count for part in (shown if still else asking))
    blocks = max(min(part.columns, part.rows) for part in random) if still else None
    ends = []
    for (k, c), (a, b) in zip(_MOVING, _STILL, strict=True):
        error = k * s2 / patterns + c * rho**2 / patterns**1.2
        ends.append(-10 * log10(error if blocks is None else error + a * rho**2 / blocks**b))
    return Quality(low=ends[0], high=ends[1], blocks=blocks)
