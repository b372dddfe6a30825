"""A pattern program: its bits, its numbering, its sensing rows against plain loops, and what it refuses."""

import hashlib
import tracemalloc
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from storage.errors import OptionError
from workflows.grids import smallest_grid
from workflows.program import SENSING_BYTES, Bernoulli, Program
from workflows.tone import Gamma


def program(*parts: dict[str, Any], width: int = 96, height: int = 72) -> Program:
    constant = {"kind": "constant", "levels": [0, 1]}
    monitor = {"width": width, "height": height}
    return Program.model_validate({"monitor": monitor, "parts": [constant, *parts]})


def grid(columns: int, rows: int, count: int = 3, seed: int = 7, colour: str = "grey") -> dict[str, Any]:
    return {
        "kind": "bernoulli",
        "columns": columns,
        "rows": rows,
        "count": count,
        "seed": seed,
        "colour": colour,
    }


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
        ([{"kind": "constant", "levels": [0, 1]}, {"kind": "images", "files": []}], "at least 1 item"),
    ],
)
def test_programs_that_can_not_work_are_refused(parts: list[dict[str, Any]], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        Program.model_validate({"monitor": {"width": 96, "height": 72}, "parts": parts})
