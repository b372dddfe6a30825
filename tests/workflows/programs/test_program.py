"""A program: the numbering of its patterns, their pictures, and what it refuses."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from tests.workflows.programs.parts import grid, program, shown, stripes
from workflows.programs.program import Program


def test_function_of_each_value_may_be_applied_before_enlarging() -> None:
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


def test_ends_are_the_darkest_and_the_brightest_constants_of_all_or_of_some() -> None:
    colours = [[1, 1, 1], [0, 0, 0], [0, 0, 1], [0, 0, 0]]
    made = Program.model_validate(
        {
            "monitor": {"width": 96, "height": 72},
            "parts": [grid(8, 6, count=2), {"kind": "constant", "colours": colours}],
        }
    )
    assert [end.tolist() for end in made.ends()] == [[3, 5], [2]]
    assert [end.tolist() for end in made.ends([0, 4, 5])] == [[5], [4]]
    assert made.black.tolist() == [3, 5]


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
        (
            [{"kind": "constant", "levels": [0, 1]}, stripes("x", 2, 1, "rgb")],
            "finer than the monitor's 96 .* first and three times count may add up to 6",
        ),
        ([{"kind": "constant", "levels": [0, 1]}, {"kind": "images", "files": []}], "at least 1 item"),
        ([{"kind": "constant", "levels": [0, 1]}, *[grid(1, 1)] * 1000], "at most 1000 items"),
        ([{"kind": "constant", "levels": [0] * 100_001}, grid(4, 3)], "at most 100000 items"),
        ([{"kind": "constant", "levels": [0, 1]}, grid(1, 1, count=99_999)], "100001 patterns, more than"),
    ],
)
def test_invalid_programs_are_refused(parts: list[dict[str, Any]], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        Program.model_validate({"monitor": {"width": 96, "height": 72}, "parts": parts})
