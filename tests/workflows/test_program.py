"""A pattern program: its bits, its numbering, its sensing rows against plain loops, and what it refuses."""

import hashlib
import tracemalloc
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from storage.errors import OptionError
from workflows.grids import smallest_grid
from workflows.presets import preset
from workflows.program import SENSING_BYTES, Bernoulli, Monitor, Program, Stripes
from workflows.tone import Gamma


def program(*parts: dict[str, Any], width: int = 96, height: int = 72) -> Program:
    constant = {"kind": "constant", "levels": [0, 1]}
    monitor = {"width": width, "height": height}
    return Program.model_validate({"monitor": monitor, "parts": [constant, *parts]})


def grid(
    columns: int, rows: int, count: int = 3, seed: int = 7, colour: str = "grey", offset: bool = False
) -> dict[str, Any]:
    return {
        "kind": "bernoulli",
        "columns": columns,
        "rows": rows,
        "count": count,
        "seed": seed,
        "colour": colour,
        "offset": offset,
    }


def stripes(axis: str, count: int, first: int = 0) -> dict[str, Any]:
    return {"kind": "stripes", "axis": axis, "count": count, "first": first}


def shown(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """A pattern on the monitor's pixels, by the rule of the format."""
    rows, columns, _ = values.shape
    y, x = np.arange(height)[:, None], np.arange(width)
    return values[y * rows // height, x * columns // width]


def test_bits_are_the_raw_words_of_pcg64() -> None:
    # PCG XSL RR 128/64, written out: the state that numpy derives from the seed, and the published step.
    part = Bernoulli.model_validate(grid(5, 4, count=7, seed=2**64 - 1, colour="rgb"))
    state = np.random.PCG64(2**64 - 1).state["state"]
    at, step, word = state["state"], state["inc"], 2**64
    expected: list[int] = []
    while len(expected) < 7 * 4 * 5 * 3:
        at = (at * 0x2360ED051FC65DA44385DF649FCCF645 + step) % 2**128
        mixed, turn = (at >> 64) ^ (at % word), at >> 122
        out = ((mixed >> turn) | (mixed << (64 - turn))) % word
        expected += [out >> bit & 1 for bit in range(64)]
    bits = part.bits
    assert bits.shape == (7, 4, 5, 3)
    assert bits.ravel().tolist() == expected[: bits.size]


@pytest.mark.parametrize(("columns", "rows", "colour"), [(16, 12, "grey"), (7, 5, "rgb"), (3, 3, "grey")])
def test_one_pattern_is_the_one_among_all(columns: int, rows: int, colour: str) -> None:
    part = Bernoulli.model_validate(grid(columns, rows, count=40, colour=colour))
    np.testing.assert_array_equal([part.pattern(i) for i in range(40)], part.bits)


def test_bits_never_change() -> None:
    bits = Bernoulli.model_validate(grid(16, 12, count=24, seed=7)).bits
    assert "".join(map(str, bits[0, 0, :, 0])) == "1101000101010010"
    assert (
        hashlib.sha256(bits.tobytes()).hexdigest()
        == "89db07884cbe687ebec95b05595a59c5488589a5cc7fd1862170f55030d89064"
    )


def test_a_longer_part_begins_like_a_shorter_one() -> None:
    short, long = (Bernoulli.model_validate(grid(5, 3, count=n)).bits for n in (2, 9))
    np.testing.assert_array_equal(long[:2], short)


@pytest.mark.parametrize(("columns", "rows", "count", "colour"), [(5, 4, 7, "rgb"), (8, 8, 3, "grey")])
def test_offsets_are_the_words_after_the_bits(columns: int, rows: int, count: int, colour: str) -> None:
    fixed = Bernoulli.model_validate(grid(columns, rows, count, colour=colour))
    part = Bernoulli.model_validate(grid(columns, rows, count, colour=colour, offset=True))
    np.testing.assert_array_equal(part.bits, fixed.bits)
    before = -(-part.bits.size // 64)
    words = [int(word) for word in np.random.PCG64(7).random_raw(before + count)[before:]]
    expected = [[word % 2**32 % 96, word // 2**32 % 72] for word in words]
    monitor = Monitor(width=96, height=72)
    assert part.offsets(monitor).tolist() == expected
    assert not fixed.offsets(monitor).any()


def test_offsets_never_change() -> None:
    part = Bernoulli.model_validate(grid(16, 12, count=3, offset=True))
    assert part.offsets(Monitor(width=1280, height=960)).tolist() == [[289, 519], [584, 122], [1157, 98]]


def test_a_pattern_with_an_offset_is_rolled_over_the_monitor() -> None:
    made = program(grid(8, 6, 3, offset=True), grid(5, 7, 2, 9, "rgb", offset=True), width=13, height=11)
    pictures = list(made.pictures(2, made.count))
    at = 0
    for part in made.parts[1:]:
        assert isinstance(part, Bernoulli)
        bits, offsets = part.bits, part.offsets(made.monitor)
        for n in range(part.count):
            dx, dy = offsets[n]
            assert pictures[at].shape == (11, 13, part.channels)
            for y in range(11):
                for x in range(13):
                    row, column = (y + dy) % 11 * part.rows // 11, (x + dx) % 13 * part.columns // 13
                    assert pictures[at][y, x].tolist() == bits[n, row, column].tolist()
            at += 1
    for picture, values in zip(pictures, made.values(2, made.count), strict=True):
        np.testing.assert_array_equal(values, picture)


@pytest.mark.parametrize(("axis", "size", "other"), [("x", 96, 72), ("y", 72, 96), ("x", 64, 3)])
def test_stripes_are_the_bits_of_a_gray_code(axis: str, size: int, other: int) -> None:
    width, height = (size, other) if axis == "x" else (other, size)
    pictures = list(program(stripes(axis, 6), width=width, height=height).pictures(2, 8))
    along = [picture[0, :, 0] if axis == "x" else picture[:, 0, 0] for picture in pictures]
    for picture, line in zip(pictures, along, strict=True):
        assert picture.dtype == np.float32
        across = line[None, :, None] if axis == "x" else line[:, None, None]
        np.testing.assert_array_equal(picture, np.broadcast_to(across, (height, width, 1)))
    words = []
    for position in range(size):
        stripe = position * 2**6 // size
        gray = stripe ^ (stripe >> 1)
        words.append(gray)
        assert [int(line[position]) for line in along] == [gray >> 5 - i & 1 for i in range(6)]
    # What the code is for: neighbours differ in one pattern at most, and all stripes are told apart.
    assert len(set(words)) == 64
    assert all((a ^ b).bit_count() <= 1 for a, b in pairwise(words))


def test_stripes_may_start_from_a_finer_one() -> None:
    every = list(program(stripes("y", 6)).pictures(2, 8))
    some = list(program(stripes("y", 2, first=3)).pictures(2, 4))
    np.testing.assert_array_equal(some, every[3:5])
    assert Stripes.model_validate(stripes("y", 2, first=3)).values(1).shape == (32, 1, 1)


def test_a_function_of_each_value_alone_may_come_before_the_pixels() -> None:
    rng = np.random.default_rng(0)
    rolled = grid(5, 4, 3, colour="rgb", offset=True)
    files = {"kind": "images", "files": ["small.png", "large.png"]}
    made = program(rolled, files, stripes("x", 2), width=13, height=11)
    images = [rng.random((4, 6, 1), np.float32), rng.random((30, 17, 3), np.float32)]
    sizes = []

    def to_bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
        sizes.append(values.shape[0] * values.shape[1])
        return np.rint(255 * values**2).astype(np.uint8)

    pictures = made.pictures(0, made.count, images)
    for got, picture in zip(made.mapped(to_bytes, 0, made.count, images), pictures, strict=True):
        assert got.dtype == np.uint8
        np.testing.assert_array_equal(got, np.rint(255 * picture**2))
    # the large image is put on the pixels first
    assert sizes == [1, 1, 20, 20, 20, 24, 11 * 13, 2, 4]


def test_pictures_are_the_patterns_on_the_monitors_pixels() -> None:
    images = [np.random.default_rng(0).random((5, 7, 3), np.float32), np.ones((1, 1, 1), np.float32)]
    made = program(
        grid(13, 11, 2, colour="rgb"),
        {"kind": "images", "files": ["a.png", "b.png"]},
        {"kind": "constant", "colours": [[0.1, 0.2, 0.3]]},
        stripes("x", 3),
    )
    every = list(made.pictures(0, made.count, images))
    assert len(every) == made.count == 10
    for picture, values in zip(every, made.values(0, made.count, images), strict=True):
        assert picture.dtype == np.float32
        np.testing.assert_array_equal(picture, np.broadcast_to(shown(values, 96, 72), picture.shape))
        assert picture.shape == (72, 96, values.shape[2])
    for first, last in ((0, 3), (3, 6), (5, 10), (4, 4)):
        for part, whole in zip(made.pictures(first, last, images), every[first:last], strict=True):
            np.testing.assert_array_equal(part, whole)


def test_patterns_are_numbered_through_the_parts() -> None:
    images = [np.full((1, 2, 1), v, np.float32) for v in (0.3, 0.6)]
    made = Program.model_validate(
        {
            "monitor": {"width": 96, "height": 72},
            "parts": [
                grid(8, 6, count=2),
                {"kind": "constant", "levels": [0, 0.5]},
                {"kind": "images", "files": ["a.png", "b.png"]},
                grid(4, 3, count=3, colour="rgb"),
                {"kind": "constant", "colours": [[0.1, 0.2, 0.3]]},
            ],
        }
    )
    assert made.count == 10
    assert made.starts == (0, 2, 4, 6, 9, 10)
    numbers, sent = made.constants
    assert numbers.tolist() == [2, 3, 9]
    np.testing.assert_allclose(sent, [[0, 0, 0], [0.5, 0.5, 0.5], [0.1, 0.2, 0.3]])
    assert made.measured.tolist() == [0, 1, 4, 5, 6, 7, 8]
    every = made.values(0, 10, images)
    shapes = [v.shape for v in every]
    assert shapes == [(6, 8, 1)] * 2 + [(1, 1, 3)] * 2 + [(1, 2, 1)] * 2 + [(3, 4, 3)] * 3 + [(1, 1, 3)]
    assert [float(v.ravel()[0]) for v in every[2:6]] == pytest.approx([0, 0.5, 0.3, 0.6])
    for first, last in ((0, 1), (1, 4), (3, 9), (5, 10), (4, 4)):
        for part, whole in zip(made.values(first, last, images), every[first:last], strict=True):
            np.testing.assert_array_equal(part, whole)


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


def test_grids_without_an_offset_make_the_levels_where_there_are_any() -> None:
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
def test_what_is_too_large_is_refused_without_using_memory(parts: list[dict[str, Any]]) -> None:
    tracemalloc.start()
    try:
        with pytest.raises((OptionError, ValidationError), match=f"more than {SENSING_BYTES}"):
            program(*parts, width=2048, height=2048).sensing("linear")
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("parts", "why"),
    [
        ([], "at least 1 item"),
        ([{"kind": "constant", "levels": [0, 1]}], "only constant parts"),
        ([grid(4, 3)], "no two different constant levels"),
        ([{"kind": "constant", "levels": [0.5, 0.5]}, grid(4, 3)], "no two different constant levels"),
        (
            [{"kind": "constant", "colours": [[0, 0, 1], [1, 1, 1]]}, grid(4, 3)],
            "no two different constant levels",
        ),
        ([{"kind": "constant", "levels": [0, 1.5]}, grid(4, 3)], "less than or equal to 1"),
        ([{"kind": "constant", "levels": []}, grid(4, 3)], "either levels or colours"),
        ([{"kind": "constant", "levels": [0, 1]}, grid(97, 3)], "finer than the monitor"),
        ([{"kind": "constant", "levels": [0, 1]}, grid(0, 3)], "greater than or equal to 1"),
        ([{"kind": "constant", "levels": [0, 1]}, grid(4, 3, seed=-1)], "greater than or equal to 0"),
        ([{"kind": "constant", "levels": [0, 1]}, {"kind": "spiral"}], "kind"),
        ([{"kind": "constant", "levels": [0, 1]}, stripes("z", 3)], "'x' or 'y'"),
        ([{"kind": "constant", "levels": [0, 1]}, stripes("x", 7)], "finer than the monitor's 96 .* up to 6"),
        (
            [{"kind": "constant", "levels": [0, 1]}, stripes("y", 3, 4)],
            "finer than the monitor's 72 .* up to 6",
        ),
        ([{"kind": "constant", "levels": [0, 1]}, {"kind": "images", "files": []}], "at least 1 item"),
    ],
)
def test_programs_that_can_not_work_are_refused(parts: list[dict[str, Any]], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        Program.model_validate({"monitor": {"width": 96, "height": 72}, "parts": parts})
