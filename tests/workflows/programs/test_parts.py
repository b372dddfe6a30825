"""The parts of a program: their bits, offsets and stripes, by the rules of the format."""

import hashlib
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from tests.workflows.programs.parts import grid, program, stripes
from workflows.programs.parts import Bernoulli, Halftone, Monitor, Stripes


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
def test_single_pattern_equals_that_of_the_whole_part(columns: int, rows: int, colour: str) -> None:
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
    # What the code is for: neighbours differ in one pattern at most, and all stripes are distinct.
    assert len(set(words)) == 64
    assert all((a ^ b).bit_count() <= 1 for a, b in pairwise(words))


def test_stripes_may_start_from_a_finer_one() -> None:
    every = list(program(stripes("y", 6)).pictures(2, 8))
    some = list(program(stripes("y", 2, first=3)).pictures(2, 4))
    np.testing.assert_array_equal(some, every[3:5])
    assert Stripes.model_validate(stripes("y", 2, first=3)).values(1).shape == (32, 1, 1)


@pytest.mark.parametrize(("count", "first"), [(2, 0), (1, 2)])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_coloured_stripes_are_three_at_once_with_the_coarsest_in_red(
    axis: str, count: int, first: int
) -> None:
    grey = list(program(stripes(axis, 6)).pictures(2, 8))
    coloured = list(program(stripes(axis, count, first, "rgb")).pictures(2, 2 + count))
    for n, picture in enumerate(coloured):
        at = first + 3 * n
        np.testing.assert_array_equal(picture, np.concatenate(grey[at : at + 3], axis=2))


@pytest.mark.parametrize("level", [0.25, 0.5, 0.75])
def test_half_tones_are_dots_of_two_pixels(level: float) -> None:
    part = Halftone(kind="halftone", levels=(level,))
    shown = part.values(0, Monitor(width=41, height=30))
    assert shown.shape == (30, 41, 1)
    assert set(np.unique(shown)) == {0.0, 1.0}
    assert shown[:28, :40].mean() == pytest.approx(level)
    np.testing.assert_array_equal(shown[:28:2, :40], shown[1:28:2, :40])
    np.testing.assert_array_equal(shown[:28, :40:2], shown[:28, 1:40:2])


def test_half_tones_of_other_levels_are_refused() -> None:
    with pytest.raises(ValidationError, match="multiple of"):
        Halftone.model_validate({"kind": "halftone", "levels": [0.3]})
