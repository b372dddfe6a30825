"""The sensing rows of a program at its grids, against plain loops."""

import tracemalloc
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from storage.errors import OptionError
from tests.workflows.programs.parts import grid, program, shown, stripes
from workflows.images.resample import smallest_grid
from workflows.images.tone_curves import Gamma
from workflows.programs.presets import preset
from workflows.programs.program import SENSING_BYTES


@pytest.mark.parametrize("colour", ["grey", "rgb"])
def test_sensing_rows_are_the_patterns_over_the_cells(colour: str) -> None:
    made = program(grid(4, 3, 5), grid(8, 6, 4, 8, colour), grid(24, 18, 3, 9))
    sensing = made.sensing("linear")
    assert [(level.columns, level.rows) for level in sensing.levels] == [(4, 3), (8, 6), (24, 18)]
    assert [level.patterns.tolist() for level in sensing.levels] == [
        list(range(5)),
        list(range(9)),
        list(range(12)),
    ]
    channels = 3 if colour == "rgb" else 1
    values = made.values(2, made.count)
    for level in sensing.levels:
        assert level.light.shape == (channels, level.rows * level.columns, len(level.patterns))
        assert level.light.dtype == np.float32
        for m, n in enumerate(level.patterns):
            picture = shown(values[n], 96, 72)
            for row in range(level.rows):
                for column in range(level.columns):
                    y, x = 72 // level.rows * row, 96 // level.columns * column
                    cell = picture[y : y + 72 // level.rows, x : x + 96 // level.columns]
                    for channel in range(channels):
                        got = level.light[channel, row * level.columns + column, m]
                        assert got == cell[..., min(channel, cell.shape[2] - 1)].mean()


def test_grids_are_taken_from_coarse_to_fine_whatever_their_order() -> None:
    sensing = program(grid(24, 18, 2), grid(4, 3, 5)).sensing("linear")
    assert [(level.columns, level.rows) for level in sensing.levels] == [(4, 3), (24, 18)]
    assert [level.patterns.tolist() for level in sensing.levels] == [[2, 3, 4, 5, 6], [0, 1, 2, 3, 4, 5, 6]]


@pytest.mark.parametrize("colour", ["grey", "rgb"])
def test_images_of_a_grid_sense_as_the_grid_does(colour: str) -> None:
    made = program(grid(8, 6, 4, 1, colour), grid(24, 18, 4, 2, colour))
    pictures = [smallest_grid(shown(v, 96, 72)) for v in made.values(2, made.count)]
    assert [p.shape[:2] for p in pictures] == [(6, 8)] * 4 + [(18, 24)] * 4
    names = [f"{n}.png" for n in range(8)]
    as_images = program({"kind": "images", "files": names[:3]}, {"kind": "images", "files": names[3:]})
    for curve in ("linear", "srgb", Gamma(gamma=2.2)):
        expected = made.sensing(curve)  # type: ignore[arg-type]
        got = as_images.sensing(curve, pictures)  # type: ignore[arg-type]
        for a, b in zip(expected.levels, got.levels, strict=True):
            assert (a.columns, a.rows) == (b.columns, b.rows)
            np.testing.assert_array_equal(a.patterns, b.patterns)
            np.testing.assert_array_equal(a.light, b.light)


def test_the_monitors_curve_turns_images_to_light() -> None:
    made = program({"kind": "images", "files": ["a.png"]})
    picture = np.array([[[0.5], [1.0]]], np.float32)
    light = made.sensing(Gamma(gamma=2.0), [picture]).levels[0].light
    np.testing.assert_allclose(light[0, :, 0], [0.25, 1])


def test_a_photograph_is_averaged_over_the_finest_cells() -> None:
    made = program(grid(4, 3), {"kind": "images", "files": ["a.png"]}, grid(8, 6))
    photograph = np.random.default_rng(0).random((48, 64, 3), np.float32)
    coarse, fine = made.sensing("linear", [photograph]).levels
    assert coarse.patterns.tolist() == [0, 1, 2]
    assert fine.patterns.tolist() == list(range(7))
    assert fine.light.shape[0] == 3
    means = photograph.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3)).reshape(48, 3).T
    np.testing.assert_allclose(fine.light[:, :, 3], means, rtol=1e-5)


@pytest.mark.parametrize(("columns", "rows"), [(4, 2), (2, 3), (4, 3), (1, 2), (8, 6), (3, 3)])
def test_an_image_is_sensed_from_the_first_grid_that_holds_it(columns: int, rows: int) -> None:
    made = program(grid(4, 3), {"kind": "images", "files": ["a.png"]}, grid(8, 6))
    image = np.random.default_rng(0).random((rows, columns, 1), np.float32)
    coarse, fine = made.sensing("linear", [image]).levels
    assert (3 in coarse.patterns) == (4 % columns == 0 and 3 % rows == 0)
    assert 3 in fine.patterns
    if 3 in coarse.patterns:
        expected = image.repeat(3 // rows, axis=0).repeat(4 // columns, axis=1)
        np.testing.assert_array_equal(coarse.light[0, :, 3], expected.ravel())


def test_offset_patterns_are_averaged_over_the_cells_from_their_own_grid_on() -> None:
    made = program(
        grid(4, 3, 2, 1, offset=True), grid(16, 12, 2, 2, "rgb", offset=True), grid(8, 6, 2, 3, offset=True)
    )
    assert made.bands() == [(4, 3), (8, 6), (16, 12)]
    sensing = made.sensing("linear")
    assert [level.patterns.tolist() for level in sensing.levels] == [
        [0, 1],
        [0, 1, 4, 5],
        [0, 1, 2, 3, 4, 5],
    ]
    pictures = list(made.pictures(2, made.count))
    for level in sensing.levels:
        high, wide = 72 // level.rows, 96 // level.columns
        assert level.light.shape[0] == 3
        for m, n in enumerate(level.patterns):
            picture = np.broadcast_to(pictures[n], (72, 96, 3))
            cells = picture.reshape(level.rows, high, level.columns, wide, 3).mean(axis=(1, 3))
            np.testing.assert_allclose(level.light[:, :, m], cells.reshape(-1, 3).T, atol=1e-6)


def test_grids_without_an_offset_are_preferred_as_levels() -> None:
    made = program(grid(5, 7, 2, offset=True), grid(8, 6), grid(64, 48, 1, 2, offset=True), grid(16, 12))
    assert made.bands() == [(8, 6), (16, 12)]
    coarse, fine = made.sensing("linear").levels
    assert coarse.patterns.tolist() == [2, 3, 4]
    assert fine.patterns.tolist() == list(range(9))
    (picture,) = made.pictures(7, 8)
    cells = picture.reshape(12, 6, 16, 6).mean(axis=(1, 3)).ravel()
    np.testing.assert_allclose(fine.light[0, :, 5], cells, atol=1e-6)


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ([(4, 3), (5, 5), (8, 6), (20, 15), (40, 30)], [(4, 3), (8, 6), (40, 30)]),
        ([(2, 2), (3, 3), (9, 9), (16, 16)], [(2, 2), (16, 16)]),
        ([(4, 3), (12, 1), (6, 8), (7, 7)], [(7, 7)]),
    ],
)
def test_offset_grids_that_do_not_nest_leave_the_longest_chain(
    sizes: list[tuple[int, int]], expected: list[tuple[int, int]]
) -> None:
    made = program(*(grid(*size, count=1, offset=True) for size in sizes))
    bands = made.bands()
    assert bands[-1] == expected[-1]
    assert len(bands) == len(expected)
    assert all(fine[i] % coarse[i] == 0 for coarse, fine in pairwise(bands) for i in (0, 1))
    levels = made.sensing("linear").levels
    assert [(level.columns, level.rows) for level in levels] == bands
    assert levels[-1].patterns.size == len(sizes)


def test_stripes_join_the_levels_that_hold_them() -> None:
    made = program(grid(4, 3, 1), grid(16, 12, 1), stripes("x", 5), stripes("y", 2))
    coarse, fine = made.sensing("linear").levels
    assert coarse.patterns.tolist() == [0, 2, 3]
    assert fine.patterns.tolist() == list(range(9))
    pictures = list(made.pictures(2, made.count))
    for n in range(9):
        cells = pictures[n].reshape(12, 6, 16, 6).mean(axis=(1, 3)).ravel()
        np.testing.assert_allclose(fine.light[0, :, n], cells, atol=1e-6)


def test_coloured_stripes_are_on_the_grid_of_their_finest() -> None:
    made = program(grid(4, 4, 1), stripes("x", 1, 0, "rgb"), grid(8, 8, 1, colour="rgb"))
    coarse, fine = made.sensing("linear").levels
    assert (coarse.patterns.tolist(), fine.patterns.tolist()) == ([0], [0, 1, 2])
    stripe = list(made.pictures(2, made.count))[1]
    for channel in range(3):
        cells = stripe[..., channel].reshape(8, 9, 8, 12).mean(axis=(1, 3)).ravel()
        np.testing.assert_array_equal(fine.light[channel, :, 1], cells)


def test_stripes_alone_make_levels_that_hold_both_axes() -> None:
    made = program(stripes("x", 5), stripes("y", 2, first=2))
    levels = made.sensing("linear").levels
    grids = [(level.columns, level.rows) for level in levels]
    assert grids == [(2, 2), (4, 4), (8, 8), (16, 16), (32, 16)]
    assert [level.patterns.size for level in levels] == [1, 2, 4, 6, 7]
    assert levels[-1].patterns.tolist() == list(range(7))
    pictures = list(made.pictures(2, made.count))
    for level in levels:
        for m, n in enumerate(level.patterns):
            columns, rows = level.columns, level.rows
            exact = shown(level.light[0, :, m].reshape(rows, columns, 1), 96, 72)
            np.testing.assert_array_equal(exact, pictures[n])


def test_levels_coarser_than_every_pattern_are_left_out() -> None:
    """Coloured stripes lie on the grid of the finest of three."""
    levels = program(stripes("x", 2, 0, "rgb"), stripes("y", 1, 0, "rgb")).sensing("linear").levels
    grids = [(level.columns, level.rows) for level in levels]
    assert grids == [(8, 8), (16, 8), (32, 8), (64, 8)]
    assert [level.patterns.tolist() for level in levels] == [[0, 2], [0, 2], [0, 2], [0, 1, 2]]


def test_levels_that_are_too_large_are_left_out() -> None:
    parts = [grid(64, 64, 64), grid(256, 256, 64), grid(1024, 1024, 64)]
    levels = program(*parts, width=1024, height=1024).sensing("linear").levels
    assert [(level.columns, level.rows) for level in levels] == [(64, 64), (256, 256)]
    assert levels[-1].patterns.size == 192


def test_a_program_without_a_level_that_fits_is_refused() -> None:
    made = program(grid(1024, 1024, 120), grid(1, 1, 1, colour="rgb", offset=True), width=1024, height=1024)
    with pytest.raises(OptionError, match=f"more than {SENSING_BYTES}"):
        made.sensing("linear")


@pytest.mark.parametrize("name", ["default", "quick", "sketch", "paper-250", "paper-400"])
@pytest.mark.parametrize("size", [(96, 72), (160, 90)])
def test_every_preset_can_be_sensed(name: str, size: tuple[int, int]) -> None:
    made = preset(name, *size)
    levels = made.sensing("linear").levels
    assert levels[-1].patterns.size == len(made.measured)
    for coarse, fine in pairwise(levels):
        assert fine.columns % coarse.columns == fine.rows % coarse.rows == 0
    assert all(level.patterns.size > 0 for level in levels)


@pytest.mark.parametrize("other", [(8, 9), (12, 12), (6, 12), (13, 11)])
def test_grids_that_do_not_nest_are_refused(other: tuple[int, int]) -> None:
    made = program(grid(8, 6), grid(*other))
    with pytest.raises(OptionError, match="do not nest") as caught:
        made.sensing("linear")
    assert caught.value.fields["field"] == "program"
    for size in ((8, 6), other):
        assert f"{size[0]} x {size[1]}" in caught.value.detail


@pytest.mark.parametrize(
    "parts",
    [
        [grid(1024, 1024, 256, colour="grey"), grid(1, 1, 1)],
        [grid(1024, 1024, 84, colour="rgb"), grid(512, 512, 8)],
        [grid(512, 512, 1000), grid(1024, 1024, 5)],
    ],
)
def test_level_that_is_too_large_is_refused_without_using_memory(parts: list[dict[str, Any]]) -> None:
    tracemalloc.start()
    try:
        with pytest.raises((OptionError, ValidationError), match=f"more than {SENSING_BYTES}"):
            program(*parts, width=2048, height=2048).sensing("linear")
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


def test_images_of_either_axis_are_sensed_along_both() -> None:
    rng = np.random.default_rng(0)
    sizes = [(1, 4), (1, 8), (1, 32), (3, 1), (6, 1), (24, 1)]
    images = [rng.random((*size, 1), np.float32) for size in sizes]
    names = [f"{n}.png" for n in range(len(images))]
    levels = program({"kind": "images", "files": names}).sensing("linear", images).levels
    assert [(level.columns, level.rows) for level in levels] == [(4, 3), (8, 6), (32, 24)]
    assert [level.patterns.tolist() for level in levels] == [[0, 3], [0, 1, 3, 4], list(range(6))]
    for level in levels:
        for m, n in enumerate(level.patterns):
            cells = level.light[0, :, m].reshape(level.rows, level.columns, 1)
            np.testing.assert_allclose(shown(cells, 96, 72), shown(images[n], 96, 72), rtol=1e-6)
