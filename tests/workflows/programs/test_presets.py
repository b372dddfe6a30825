"""Presets: what they show, on monitors of any size."""

from itertools import pairwise

import numpy as np
import pytest

from storage.errors import OptionError
from workflows.programs.parts import Bernoulli, Stripes
from workflows.programs.presets import IN_GREY, RECIPES, preset

COUNTS = {"default": 140, "quick": 61, "sketch": 37, "paper-250": 282, "paper-400": 432}
MONITORS = [
    (1280, 960),
    (1920, 1080),
    (1080, 1920),
    (2560, 1080),
    (1280, 1024),
    (3840, 2160),
    (96, 72),
    (13, 12),
]


def grids(name: str, width: int, height: int) -> list[Bernoulli]:
    return [part for part in preset(name, width, height).parts if isinstance(part, Bernoulli)]


def test_all_presets_are_listed() -> None:
    assert set(RECIPES) == set(COUNTS)


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize(("width", "height"), MONITORS)
def test_a_preset_shows_as_many_patterns_on_any_monitor(name: str, width: int, height: int) -> None:
    made = preset(name, width, height)
    assert (made.monitor.width, made.monitor.height) == (width, height)
    assert made.monitor.response == "unknown"
    assert made.count == COUNTS[name]
    parts = grids(name, width, height)
    assert len({part.seed for part in parts}) == len(parts)
    for part in parts:
        assert part.columns <= width
        assert part.rows <= height
    for coarse, fine in pairwise(parts):
        assert fine.columns % coarse.columns == fine.rows % coarse.rows == 0
        assert fine.columns > coarse.columns


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize(("width", "height"), [(1280, 960), (1920, 1080), (2560, 1080), (1280, 1024)])
def test_blocks_are_about_square_and_turn_with_the_monitor(name: str, width: int, height: int) -> None:
    parts = grids(name, width, height)
    for part in parts:
        assert (width / part.columns) / (height / part.rows) == pytest.approx(1, abs=0.08)
    turned = [(part.rows, part.columns, part.count) for part in grids(name, height, width)]
    assert turned == [(part.columns, part.rows, part.count) for part in parts]


def test_the_grids_are_those_of_the_recipes() -> None:
    every = [(8, 6), (16, 12), (32, 24), (64, 48), (128, 96), (256, 192), (512, 384)]
    for name, bands in (("default", 7), ("quick", 7), ("sketch", 6)):
        parts = grids(name, 1280, 960)
        assert [(part.columns, part.rows) for part in parts] == every[:bands]
        assert all(part.offset for part in parts)
        colour, stripes = ("grey", 8) if name == "default" else ("rgb", 9)
        assert {part.colour for part in parts} == {colour}
        for axis in ("x", "y"):
            shown = [
                (part.first + n * part.channels, part.colour)
                for part in preset(name).parts
                if isinstance(part, Stripes) and part.axis == axis
                for n in range(part.count)
            ]
            assert shown == [(first, colour) for first in range(0, stripes, 3 if colour == "rgb" else 1)]
    for name, fine in (("paper-250", 250), ("paper-400", 400)):
        parts = grids(name, 1280, 960)
        assert [(part.columns, part.rows, part.count) for part in parts] == [(16, 12, 24), (128, 96, fine)]
        assert not any(part.offset for part in parts)


@pytest.mark.parametrize("name", COUNTS)
def test_a_preset_has_as_many_patterns_in_black_and_white(name: str) -> None:
    for size in MONITORS:
        assert preset(name, *size, grey=True).count == COUNTS[name]
    made = preset(name, grey=True)
    assert {part.colour for part in made.parts if isinstance(part, Bernoulli | Stripes)} == {"grey"}
    assert (made == preset(name)) == (name not in IN_GREY)


@pytest.mark.parametrize("name", ["default", "quick", "sketch"])
def test_calibration_comes_first_and_black_and_white_again_in_the_middle_and_at_the_end(name: str) -> None:
    made = preset(name)
    numbers, sent = made.constants
    white, black = [1, 1, 1], [0, 0, 0]
    first = [white, [1, 0, 0], [0, 1, 0], [0, 0, 1], black]
    assert sent.tolist() == [*first, white, black, black, white]
    assert numbers[:5].tolist() == [0, 1, 2, 3, 4]
    assert 0.3 < numbers[5] / made.count < 0.8
    assert numbers[-2:].tolist() == [made.count - 2, made.count - 1]
    tones, shares = made.halftones
    assert tones.tolist() == [5, 6, 7]
    assert shares.tolist() == [0.25, 0.5, 0.75]
    assert made.measured.size == made.count - 12


@pytest.mark.parametrize("name", ["paper-250", "paper-400"])
def test_the_programs_of_the_paper_begin_with_eight_levels(name: str) -> None:
    codes = preset(name).constants[1] * 255
    np.testing.assert_allclose(codes, np.rint(codes), atol=1e-5)  # 8 bits hold them
    np.testing.assert_allclose(codes[:, 0], np.linspace(0, 255, 8), atol=0.5)


@pytest.mark.parametrize(("width", "height"), [(2, 2), (0, 960), (1280, 2)])
def test_a_monitor_that_is_too_small_is_refused(width: int, height: int) -> None:
    with pytest.raises(OptionError, match=f"{width} x {height} pixels is too small.*needs 6 pixels"):
        preset("default", width, height)


def test_a_band_of_pixels_is_a_monitor_too() -> None:
    for size in ((16384, 6), (6, 16384), (16384, 64)):
        assert preset("sketch", *size).count == 37


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(OptionError, match=r"'best'.*default, quick"):
        preset("best")
