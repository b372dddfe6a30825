"""What is promised of a program's composites, against what was measured of it."""

from math import log10
from typing import Any

import numpy as np
import pytest

from tests.parts.captures import nested_program
from workflows.ingest.report.expected_psnr import expected
from workflows.ingest.report.figures import Quality
from workflows.programs.parts import Constant, Monitor, Stripes
from workflows.programs.presets import preset
from workflows.programs.program import Program

SURVEY = {"contrast": 0.81, "deviation": 0.0058}
"""Of a clear ball with usual noise."""
NESTED = tuple((16 << n, 12 << n, 20) for n in range(6))


def expect(program: Program, survey: dict[str, Any] = SURVEY, **attributes: Any) -> Quality | None:
    """What is expected of a capture of all patterns of a program."""
    return expected(program, {"patterns": range(program.count), "survey": survey} | attributes)


def ends(program: Program, **other: float) -> tuple[float, float]:
    quality = expect(program, SURVEY | other)
    assert quality is not None
    assert quality.low < quality.high
    return quality.low, quality.high


def still(blocks: int, count: int = 60) -> Program:
    return nested_program((1280, 960), bands=((16, 12, 24), (4 * blocks // 3, blocks, count)), levels=2)


# PSNR of composites of the ball, the dispersing solid and the frosted lens, see the function's Notes.
@pytest.mark.parametrize(
    ("program", "measured"),
    [
        (preset("default"), (51.9, 44.9, 47.7)),
        (preset("quick"), (50.3, 41.8, 47.0)),
        (preset("sketch"), (47.0, 38.3, 45.7)),
        (preset("paper-250"), (32.6, 36.1, 42.0)),
        (nested_program((1280, 960), bands=NESTED), (39.1, 38.2, 43.3)),
        (still(48), (25.2, 32.2, 39.8)),
        (still(24, 24), (21.1, 28.2, 38.9)),
    ],
    ids=["default", "quick", "sketch", "paper-250", "nested", "48 blocks", "24 blocks"],
)
def test_no_more_is_promised_than_was_measured(program: Program, measured: tuple[float, ...]) -> None:
    ball, solid, frosted = (
        SURVEY,
        {"contrast": 0.6, "deviation": 0.0053},
        {"contrast": 0.82, "deviation": 0.0059},
    )
    for survey, psnr in zip((ball, solid, frosted), measured, strict=True):
        low, high = ends(program, **survey)
        assert low - 0.7 < psnr < high + 2


def test_grids_without_offsets_are_rated_by_their_finest_blocks() -> None:
    quality = expect(still(96))
    assert quality is not None
    assert quality.blocks == 96
    assert expect(preset("default")).blocks is None  # type: ignore[union-attr]
    coarse, fine = ends(still(24)), ends(still(384))
    assert coarse[0] < fine[0] - 8
    assert coarse[1] < fine[1]
    assert ends(still(24, 4000))[0] == pytest.approx(coarse[0], abs=1)  # more of the same do not help
    assert ends(still(384), deviation=0.05)[0] < fine[0] - 3


def test_without_random_patterns_as_much_is_expected_as_patterns_show() -> None:
    monitor = Monitor(width=64, height=48)
    stripes = Stripes(kind="stripes", axis="x", count=6)
    program = Program(monitor=monitor, parts=(Constant(kind="constant", levels=(0, 1)), stripes))
    assert expect(program) is None
    assert expect(program, SURVEY | {"contrast": 0.0}, pattern_error=0.01) is None
    found = expect(program, pattern_error=0.01)
    assert found is not None
    assert found.low == pytest.approx(37)
    assert found.high == pytest.approx(45)
    random = preset("default")
    assert expect(random, pattern_error=SURVEY["deviation"]) == expect(random)


def test_little_is_expected_of_a_camera_whose_exposure_was_free() -> None:
    program = preset("default")
    locked = expect(program, auto_exposure=np.linspace(0.97, 1.03, 140).tolist())
    assert locked == expect(program)
    free = expect(program, auto_exposure=np.linspace(0.8, 1.25, 140).tolist())
    assert free is not None
    # Shown brighter by three tenths, a backdrop of all levels is as far off as this.
    assert free.low == pytest.approx(-10 * np.log10((0.3 * SURVEY["contrast"]) ** 2 / 3), abs=0.1)
    assert 36 < free.high < 42
    steadier = expect(program, auto_exposure=np.linspace(0.88, 1.13, 140).tolist())
    assert steadier is not None
    assert steadier.low == free.low
    assert steadier.high > free.high + 3


def test_of_a_program_that_is_not_shown_to_its_end_only_what_was_shown_counts() -> None:
    program = preset("default")
    # Stripes alone say little of what they do not split.
    assert expect(program, patterns=range(24), pattern_error=0.01) is None
    found = [expect(program, patterns=range(shown)) for shown in (32, 64, 140)]
    lows = [one.low for one in found if one is not None]
    assert lows == sorted(lows)
    assert len(lows) == 3
    assert lows[-1] > lows[0] + 5
    assert found[-1] == expect(program)


def test_patterns_without_offsets_beside_others_are_not_counted() -> None:
    program = preset("default")
    more = Program(monitor=program.monitor, parts=(*program.parts, *still(96).parts[1:]))
    assert ends(more) == ends(program)


def parts(*parts: dict[str, Any]) -> Program:
    constant = {"kind": "constant", "levels": [0, 1]}
    return Program.model_validate({"monitor": {"width": 64, "height": 48}, "parts": [constant, *parts]})


def test_nothing_is_promised_without_a_measurement() -> None:
    for part in ({"kind": "images", "files": ["a.png"]}, {"kind": "stripes", "axis": "x", "count": 5}):
        assert expect(parts(part)) is None
    assert expect(preset("default"), SURVEY | {"contrast": 0.0}) is None


def test_what_no_t_explains_is_not_promised() -> None:
    program = preset("default")
    ideal, real = (expect(program, model_error=error) for error in (0.0, 0.02))
    assert ideal is not None
    assert real is not None
    assert real.low < -20 * log10(0.02 * SURVEY["contrast"]) < ideal.low
    # At best half of it, and of not more than patterns show.
    assert real.high == pytest.approx(-10 * log10((0.02 * SURVEY["contrast"]) ** 2 / 2), abs=0.5)
    shown = expect(
        program, model_error=0.02, pattern_error=np.hypot(SURVEY["deviation"], 0.01 * SURVEY["contrast"])
    )
    assert shown is not None
    assert shown.low == real.low
    assert real.high + 2 < shown.high < ideal.high - 2


@pytest.mark.parametrize("half_colour", [False, True])
def test_what_is_left_of_patterns_is_not_promised(half_colour: bool) -> None:
    # Of a brilliant in RAW by a sharp lens, with a jolt: composites had 33.8 dB.
    program, survey = preset("quick"), {"contrast": 0.32, "deviation": 0.00653}
    quality = expect(program, survey, model_error=0.0064, pattern_error=0.01396, half_colour=half_colour)
    assert quality is not None
    # JPEG has lost colours of these patterns, of which composites need less.
    assert (quality.low < 36) == (quality.high < 45) == (not half_colour)


def test_noise_that_is_left_of_patterns_costs_nothing() -> None:
    program = preset("quick")
    assert expect(program, pattern_error=1.05 * SURVEY["deviation"]) == expect(program)


def test_colours_that_a_film_has_lost_are_not_promised() -> None:
    program = preset("default")
    found = expect(program, SURVEY | {"lost_colour": 1e-3})
    assert found is not None
    assert 29 < found.low < found.high < 30


def test_colours_that_patterns_have_lost_cost_wide_rows_of_t_less() -> None:
    survey = SURVEY | {"lost_colour": 1e-3}
    grey, coloured = (expect(preset(name), survey, model_error=0.02) for name in ("default", "quick"))
    assert grey is not None
    assert coloured is not None
    assert coloured.high - coloured.low > grey.high - grey.low + 2
