"""The border of a film: drawn, filmed badly, and read."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter

from storage.errors import OptionError
from workflows.programs.border import (
    BITS,
    LEAD,
    MAX_NUMBERED,
    Border,
    Box,
    Step,
    border_light,
    draw_border,
    number_cells,
    read_numbers,
    schedule,
    tick_cells,
)

DISPLAY = Border(width=640, height=360)
DISPLAYS = [
    Border(width=w, height=h) for w, h in ((640, 360), (1920, 1080), (1080, 1920), (3440, 1440), (161, 121))
]
NUMBERS = [LEAD, 0, 1, 2, 3, 62, 63, 64, 131, 431, 1023, 2047, MAX_NUMBERED - 1]


def shown(number: int, border: Border = DISPLAY) -> NDArray[np.float64]:
    """(height, width) the light of a display, 0 to 1, with a random pattern in the rectangle."""
    picture = np.random.default_rng(number + 1).integers(0, 2, (30, 40, 1), np.uint8) * np.uint8(255)
    return draw_border(picture, number, border)[:, :, 0] / 255


def seen(light: NDArray[np.float64], boxes: tuple[Box, ...]) -> NDArray[np.float64]:
    """The mean of the inner half of each cell."""
    halves = [(x + w // 4, y + h // 4, max(w // 2, 1), max(h // 2, 1)) for x, y, w, h in boxes]
    return np.array([light[y : y + h, x : x + w].mean() for x, y, w, h in halves])


@pytest.mark.parametrize("border", DISPLAYS, ids=lambda b: f"{b.width}x{b.height}")
def test_cells_lie_in_the_border_apart_and_within_the_display(border: Border) -> None:
    owner = np.zeros((border.height, border.width), int)
    for x, y, w, h in (border.inner, *border.top, *border.bottom, *border.left, *border.right):
        assert min(x, y) >= 0
        assert (w > 0, h > 0, x + w <= border.width, y + h <= border.height) == (True,) * 4
        owner[y : y + h, x : x + w] += 1
    assert owner.max() == 1
    assert len(border.top) == len(border.bottom) == 2 * (BITS + 1)
    assert border.thickness == border.height // 20
    assert [box[0] for box in border.bottom] == [box[0] for box in border.top][::-1]


@pytest.mark.parametrize(
    ("width", "height"), [(1280, 960), (1812, 972), (153, 109), (971, 1727), (3296, 1296)]
)
def test_a_border_around_a_rectangle_has_it_inside(width: int, height: int) -> None:
    assert Border.around(width, height).inner[2:] == (width, height)


@pytest.mark.parametrize(("width", "height"), [(40, 30), (16384, 16384), (100, 9000), (0, 0)])
def test_where_no_border_fits_is_said(width: int, height: int) -> None:
    with pytest.raises(
        OptionError, match=f"{width + 2 * (height // 18)} x {height + 2 * (height // 18)} pixels"
    ):
        Border.around(width, height)
    with pytest.raises(ValidationError):
        Border(width=width, height=3 * height)


def test_codes_are_all_different_and_neighbours_differ_in_one_bit_and_the_parity() -> None:
    codes = np.array([number_cells(number) for number in range(LEAD, MAX_NUMBERED)])
    assert codes.shape == (2**BITS, 2 * (BITS + 1))
    assert len(np.unique(codes, axis=0)) == 2**BITS
    np.testing.assert_array_equal(codes[:, ::2], ~codes[:, 1::2])
    changed = codes[1:, ::2] != codes[:-1, ::2]
    assert np.all(changed.sum(axis=1) == 2)
    assert changed[:, -1].all()
    assert [bool(tick_cells(number)[0]) for number in range(LEAD, 3)] == [False, True, False, True]
    number, certain = read_numbers(codes.astype(float))
    np.testing.assert_array_equal(number, np.arange(LEAD, MAX_NUMBERED))
    assert certain.all()


@pytest.mark.parametrize(
    "border",
    [pytest.param(b, marks=pytest.mark.slow if b.width > 3000 else ()) for b in DISPLAYS],
    ids=lambda b: f"{b.width}x{b.height}",
)
def test_picture_is_unchanged_and_light_of_the_border_constant(border: Border) -> None:
    x, y, w, h = border.inner
    picture = np.random.default_rng(0).integers(0, 256, (h, w, 3), np.uint8)
    light = set()
    for number in NUMBERS:
        whole = draw_border(picture, number, border)
        assert whole.shape == (border.height, border.width, 3)
        np.testing.assert_array_equal(whole[y : y + h, x : x + w], picture)
        whole[y : y + h, x : x + w] = 0
        light.add(int(whole.sum(dtype=np.int64)))
    assert len(light) == 1


def test_a_smaller_picture_is_stretched_by_repeating_pixels() -> None:
    border = Border.around(600, 360)
    picture = np.arange(6 * 10, dtype=np.uint8).reshape(6, 10, 1)
    x, y, w, h = border.inner
    np.testing.assert_array_equal(
        draw_border(picture, 0, border)[y : y + h, x : x + w], picture.repeat(60, axis=0).repeat(60, axis=1)
    )


@pytest.mark.parametrize("edge", ["top", "bottom"])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("blur", [0.0, 0.15, 0.3])
def test_numbers_are_read_through_blur_gamma_vignetting_and_noise(
    edge: str, gamma: float, blur: float
) -> None:
    rng = np.random.default_rng(5)
    boxes: tuple[Box, ...] = getattr(DISPLAY, edge)
    y, x = np.mgrid[-1:1:360j, -1:1:640j]
    for number in NUMBERS:
        light = gaussian_filter(shown(number), blur * boxes[0][2])
        light = (0.02 + 0.6 * light) * (1 - 0.4 * (x**2 + y**2) / 2)
        filmed = light ** (1 / gamma) + rng.normal(0, 0.03, light.shape)
        found, certain = read_numbers(seen(filmed, boxes))
        assert (int(found), bool(certain)) == (number, True)


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_frame_exposed_across_a_change_reads_as_one_of_both_or_as_uncertain(gamma: float) -> None:
    rng = np.random.default_rng(6)
    for first, second in pairwise(range(LEAD, 140)):
        for share in np.linspace(0, 1, 21):
            light = (1 - share) * number_cells(first) + share * number_cells(second)
            number, certain = read_numbers((0.01 + light) ** (1 / gamma) + rng.normal(0, 0.01, light.shape))
            if certain:
                assert number == (first if share < 0.5 else second)
            if share in (0, 1):
                assert certain
            if 0.45 <= share <= 0.55:
                assert not certain


def test_a_torn_frame_shows_two_numbers_and_where_it_is_torn() -> None:
    torn = shown(41)
    torn[200:] = shown(42)[200:]
    assert [int(read_numbers(seen(torn, boxes))[0]) for boxes in (DISPLAY.top, DISPLAY.bottom)] == [41, 42]
    for side in (DISPLAY.left, DISPLAY.right):
        cells = seen(torn, side)
        odd = cells[::2] > cells[1::2]
        below = np.array([y > 200 for _, y, _, _ in side[::2]])
        np.testing.assert_array_equal(odd, below)  # 42 + 1 is odd


def test_film_of_an_unsynchronised_camera_is_read_completely() -> None:
    rng = np.random.default_rng(8)
    rate, frames_a_second, exposure, rolling = 2.0, 29.97, 1 / 60, 0.02
    steps = schedule(60, rate)
    starts = np.array([step.start for step in steps])
    codes = np.array([number_cells(step.number) for step in steps], float)
    numbers = np.array([step.number for step in steps])

    def filmed(begin: NDArray[np.float64]) -> NDArray[np.float64]:
        """The cells of an edge in frames whose exposure of it begins at these times."""
        moments = begin[:, None] + exposure * (np.arange(16) + 0.5) / 16
        shown_then = codes[np.searchsorted(starts, moments, "right") - 1].mean(axis=1)
        return (0.03 + 0.5 * shown_then) ** (1 / 2.2) + rng.normal(0, 0.02, (len(begin), codes.shape[1]))

    times = 0.011 + np.arange(int(frames_a_second * (steps[-1].start + 0.4))) / frames_a_second
    (top, sure), (bottom, sure_too) = read_numbers(filmed(times)), read_numbers(filmed(times + rolling))
    whole = sure & sure_too & (top == bottom)
    middle = times + (rolling + exposure) / 2
    np.testing.assert_array_equal(top[whole], numbers[np.searchsorted(starts, middle[whole], "right") - 1])
    assert np.all(np.bincount(top[whole & (top >= 0)], minlength=60) >= frames_a_second / rate - 3)


@pytest.mark.parametrize("level", [0.0, 0.3])
def test_no_display_in_view_is_not_certain(level: float) -> None:
    noise = np.random.default_rng(7).normal(level, 0.01, (1000, 2 * (BITS + 1)))
    assert read_numbers(noise)[1].mean() < (0.01 if level == 0 else 0.001)
    assert not read_numbers(np.full((3, 2 * (BITS + 1)), level))[1].any()


def test_one_cell_in_the_shade_is_not_certain() -> None:
    cells = number_cells(77).astype(float)
    cells[np.flatnonzero(cells)[4]] = 0
    assert not read_numbers(cells)[1]
    wrong = number_cells(77)
    wrong[:2] = ~wrong[:2]
    assert not read_numbers(wrong.astype(float))[1]


def test_schedule_has_a_lead_in_equal_times_and_a_lead_out() -> None:
    steps = schedule(5, 4)
    for before, after in pairwise(steps):
        assert after.start == pytest.approx(before.start + before.seconds)
    lead = [(1.0, False), (0.5, True), (0.5, False), (0.5, True), (0.5, False)]
    for part in (steps[:5], steps[-5:]):
        assert [(s.seconds, s.white) for s in part] == lead
        assert {s.number for s in part} == {LEAD}
    assert steps[5:-5] == [Step(3 + n / 4, 0.25, n) for n in range(5)]


def test_more_patterns_than_numbers_are_refused() -> None:
    assert schedule(MAX_NUMBERED, 2)[-6].number == MAX_NUMBERED - 1
    with pytest.raises(OptionError, match=r"4096 patterns.*4095"):
        schedule(MAX_NUMBERED + 1, 2)


def test_any_mixture_of_cells_is_a_sum_of_the_rows_of_border_light() -> None:
    numbers = range(130)
    rows = border_light(numbers)
    np.testing.assert_allclose(rows.mean(axis=1), 0, atol=1e-6)
    assert len(rows) == 9  # eight bits of numbers up to 131, and the parity
    assert np.linalg.matrix_rank(rows) == len(rows)
    cells = np.array([[*number_cells(n), *tick_cells(n)] for n in numbers], float)
    mixture = cells @ np.random.default_rng(0).random(cells.shape[1])
    design = np.concatenate([np.ones((1, len(numbers))), rows])
    left = mixture - np.linalg.lstsq(design.T, mixture)[0] @ design
    np.testing.assert_allclose(left, 0, atol=1e-5)
