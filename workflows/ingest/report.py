"""A report on a capture that a person can act on: what was measured, what it means, and what to do about it."""

from math import log10
from typing import Any

import numpy as np

from workflows.ingest.figures import Clipping, Figures, Frames, Noise, Quality, ToneCurve
from workflows.ingest.findings import LEVELS, Finding, Level, findings
from workflows.program import Program


class Report(Figures):
    """A report on a capture; ``level`` is that of the worst finding."""

    level: Level
    findings: list[Finding]


def report(attributes: dict[str, Any], frames: int) -> Report:
    """The report on a capture.

    Parameters
    ----------
    attributes : dict
        Of its stack, as `measure` and `survey` left them.
    frames : int
        Of the stack.
    """
    program = Program.model_validate(attributes["program"])
    survey, noise, steadiness = attributes["survey"], attributes["noise"], attributes["steadiness"] or {}
    said = {"monitor": program.monitor.response, "camera": attributes["response"]}
    curves = {
        name: ToneCurve(
            curve=attributes[f"{name}_curve"],
            source="assumed"
            if name in attributes["assumed_curves"]
            else "estimated"
            if response == "unknown"
            else "given",
        )
        for name, response in said.items()
    }
    made = Figures(
        frames=Frames(
            kept=frames,
            patterns=program.count,
            exposures=len(np.unique(attributes["exposures"])),
            missing=np.setdiff1d(np.arange(program.count), attributes["patterns"]).tolist(),
        ),
        clipping=Clipping(
            white=survey["white"]["clipped_high"],
            black=survey["black"]["clipped_low"],
            patterns_white=survey["patterns"]["clipped_high"],
            patterns_black=survey["patterns"]["clipped_low"],
        ),
        white_reaches=survey["white"]["reaches"],
        drift=steadiness.get("drift"),
        flicker=steadiness.get("flicker"),
        noise=Noise(
            black=255 * noise["read"] ** 0.5,
            full=255 * (noise["read"] + noise["shot"]) ** 0.5,
            read=noise["read"],
            shot=noise["shot"],
        ),
        crosstalk=attributes["crosstalk"],
        **curves,
        quality=_quality(program, survey),
        video=attributes.get("video"),
    )
    found = findings(made, program, attributes)
    return Report(**dict(made), level=max((f.level for f in found), key=LEVELS.index), findings=found)


def _quality(program: Program, survey: dict[str, Any]) -> Quality | None:
    """PSNR to expect, from the noise, the contrast and the number m of patterns.

    Notes
    -----
    The squared error is modelled as ``k s^2 / m + c rho^2 / m^1.2``: noise of the deviation s goes into some k
    parameters of T, S and rho; what the patterns did not ask is the rest, in proportion to the contrast rho. k and
    c are those of the traced scenes that `tests/benchmarks/figures.py` measures, a dispersing solid and a clear ball:
    k from the noise once and four times, c and the power from the presets of 128, 49 and 25 patterns. Ball, solid
    and a frosted lens are at most 2.5 dB outside the range, with the noisy sketch, of which the fit knew nothing.
    """
    patterns = program.measured.size
    s2, rho = survey["deviation"] ** 2, survey["contrast"]
    if rho <= 0:
        return None
    low, high = (
        -10 * log10(k * s2 / patterns + c * rho**2 / patterns**1.2) for k, c in ((19.0, 0.040), (5.5, 0.0044))
    )
    return Quality(low=low, high=high)
