"""The report on a capture: what was measured, what it means, and what to do about it."""

from typing import Any

import numpy as np

from workflows.ingest.light.stack_attributes import program_of
from workflows.ingest.report.expected_psnr import expected
from workflows.ingest.report.figures import (
    LEVELS,
    Clipping,
    Figures,
    Finding,
    Frames,
    Level,
    Noise,
    Source,
    ToneCurve,
)
from workflows.ingest.report.findings import findings
from workflows.ingest.report.limits import is_blown


class Report(Figures):
    """The report on a capture; ``level`` is that of the worst finding."""

    level: Level
    findings: list[Finding]


def report(attributes: dict[str, Any], frames: int) -> Report:
    """Write the report on a capture.

    Parameters
    ----------
    attributes : dict
        Attributes of its stack after `calibrate` and `survey`.
    frames : int
        Number of frames in the stack.
    """
    program = program_of(attributes)
    quality = None
    if not attributes.get("order") and not is_blown(attributes["survey"]):
        quality = expected(program, attributes)
    survey, noise, steadiness = attributes["survey"], attributes["noise"], attributes.get("steadiness") or {}
    figures = Figures(
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
        monitor=_curve("monitor", program.monitor.response, attributes),
        camera=_curve("camera", attributes["response"], attributes, survey.get("halftones_apart")),
        quality=quality,
        video=attributes.get("video"),
    )
    found = findings(figures, program, attributes)
    return Report(**dict(figures), level=max((f.level for f in found), key=LEVELS.index), findings=found)


def _curve(name: str, stated: Any, attributes: dict[str, Any], apart: float | None = None) -> ToneCurve:
    """The curve of the monitor or of the camera, and where it is known from."""
    source: Source = "given"
    if name in attributes["assumed_curves"]:
        source = "assumed"
    elif stated == "unknown":
        source = "estimated"
    return ToneCurve(curve=attributes[f"{name}_curve"], source=source, apart=apart)
