"""The surroundings of places in thumbnails, and the gain that follows them."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout.captures import Stack
from workflows.ingest.light.local_gain import DARK, Surroundings, local_gain, surroundings

EDGE = 3
VALUES = np.random.default_rng(3).random((2, 4, 5)).astype(np.float32)
FOUND = {"power": 0.1, "width": 1 / 40, "usual": float(np.log(0.25 + DARK))}


def stack(thumbnails: NDArray[np.uint16] | None, **attributes: Any) -> Stack:
    given = {"response": "srgb", "storage": {"black": 0}, **attributes}
    made = SimpleNamespace(
        attributes=given, thumbnails=lambda: thumbnails, height=12, width=240, dtype=np.dtype(np.uint16)
    )
    return cast(Stack, made)


def test_surroundings_of_a_block_are_those_of_its_centre() -> None:
    near = Surroundings(VALUES, EDGE)
    np.testing.assert_allclose(
        near.at(np.array([1, 4]), np.array([1, 10])), VALUES[:, [0, 1], [0, 3]], rtol=1e-6
    )


def test_surroundings_are_interpolated_and_end_with_the_last_block() -> None:
    near = Surroundings(VALUES, EDGE)
    between = (2 * VALUES[0, 0, 0] + VALUES[0, 0, 1]) / 3
    assert near.at(np.array([0]), np.array([2]), 0) == pytest.approx(between, rel=1e-6)
    assert near.at(np.array([11]), np.array([14]), 1) == VALUES[1, 3, 4]


def test_surroundings_of_a_pixel_are_the_same_in_any_rectangle() -> None:
    near = Surroundings(VALUES, EDGE)
    y, x = np.mgrid[:12, :15].reshape(2, -1)
    whole, some = near.at(y, x), near.at(y[37:90], x[37:90])
    np.testing.assert_array_equal(whole[:, 37:90], some)
    np.testing.assert_array_equal(near.at(y[37:90], x[37:90], 1), some[1])


def test_gain_is_less_where_it_is_brighter_than_usual() -> None:
    levels = np.rint(np.array([0.0, 0.25, 1.0]) * 65535).astype(np.uint16)
    gain = local_gain(
        stack(np.broadcast_to(levels[:, np.newaxis, np.newaxis], (3, 4, 80)), tone_mapping=FOUND)
    )
    assert gain is not None
    expected = ((np.array([0, 0.25, 1]) + DARK) / (0.25 + DARK)) ** -0.1
    np.testing.assert_allclose(gain.at(np.array([7]), np.array([100]))[:, 0], expected, rtol=1e-4)


def test_linear_values_count_as_they_would_be_displayed() -> None:
    levels = np.full((1, 4, 80), round(0.25**2.2 * 65535), np.uint16)
    near = surroundings(stack(levels, response="linear"), 1 / 40)
    assert near is not None
    np.testing.assert_allclose(near.values, np.log(0.25 + DARK), rtol=1e-4)


def test_without_tone_mapping_or_thumbnails_there_is_no_gain() -> None:
    levels = np.zeros((3, 4, 80), np.uint16)
    assert local_gain(stack(levels, tone_mapping=None)) is None
    assert local_gain(stack(levels)) is None
    assert local_gain(stack(None, tone_mapping=FOUND)) is None
