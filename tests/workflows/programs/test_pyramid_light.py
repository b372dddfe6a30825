"""The patterns of a program on a pyramid: the pictures at its first grid, channel after channel, whatever the room."""

import tracemalloc
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.images.resample import area_mean
from workflows.images.tone_curves import Curve, Gamma, to_light
from workflows.programs import pyramid_light
from workflows.programs.interpolation import interpolated_light
from workflows.programs.parts import Bernoulli, Constant, Halftone, Images, Monitor, Stripes
from workflows.programs.program import Program
from workflows.programs.pyramid_light import lay_out, pyramid_of
from workflows.recovery.sensing import Patterns

WIDTH, HEIGHT = 40, 30
CONSTANT = Constant(kind="constant", levels=(0, 1))
GREY = Bernoulli(kind="bernoulli", columns=8, rows=6, count=5, seed=1)
# More than are written at a time.
MANY = Bernoulli(kind="bernoulli", columns=40, rows=30, count=18, seed=2, offset=True)
RGB = Bernoulli(kind="bernoulli", columns=8, rows=6, count=4, seed=3, colour="rgb")
STRIPES = Stripes(kind="stripes", axis="x", count=3)
PHOTOGRAPHS = Images(kind="images", files=("a.png", "b.png"))


def program_of(*parts: Bernoulli | Stripes | Images | Constant) -> Program:
    return Program(monitor=Monitor(width=WIDTH, height=HEIGHT), parts=(CONSTANT, *parts))


def light_of(
    program: Program, curve: Curve = "linear", images: list[NDArray[np.float32]] | None = None
) -> NDArray[np.float32]:
    """(height, width, channels m) the light of the patterns that are not constant, channel after channel."""
    pictures = [
        to_light(picture, curve)
        for n, picture in enumerate(program.pictures(0, program.count, images or []))
        if n in program.measured
    ]
    channels = max(picture.shape[2] for picture in pictures)
    wide = [np.broadcast_to(picture, (HEIGHT, WIDTH, channels)) for picture in pictures]
    return np.stack(wide, axis=3).reshape(HEIGHT, WIDTH, -1)


def check(laid_out: Patterns, light: NDArray[np.float32]) -> None:
    """That the codes of the first grid are the light's to half a step, those of each next one a step's half further."""
    pyramid = laid_out.pyramid
    expected = 255 * pyramid.light(area_mean(light, *pyramid.grids[0]))
    assert laid_out.code.dtype == np.uint8
    assert laid_out.code.shape == expected.shape
    first = pyramid.starts[1]
    assert np.abs(laid_out.code[:first] - expected[:first]).max() <= 0.501
    assert np.abs(laid_out.code[first:] - expected[first:]).max(initial=0) <= 0.5 * len(pyramid.grids) + 0.001


def test_codes_are_the_pictures() -> None:
    program = program_of(GREY, MANY, STRIPES)
    laid_out = lay_out(program, "linear")
    assert (laid_out.channels, laid_out.count) == (1, 26)
    assert laid_out.pyramid.grids == ((WIDTH, HEIGHT), (20, 15))
    light = light_of(program)
    np.testing.assert_array_equal(laid_out.code[: WIDTH * HEIGHT], 255 * light.reshape(-1, 26))
    check(laid_out, light)


def test_constant_between_patterns_is_skipped() -> None:
    program = program_of(GREY, Constant(kind="constant", levels=(0.5,)), STRIPES, CONSTANT)
    apart = lay_out(program, "linear")
    together = lay_out(program_of(GREY, STRIPES), "linear")
    np.testing.assert_array_equal(apart.code, together.code)


def test_coloured_patterns_are_laid_out_channel_after_channel() -> None:
    program = program_of(RGB)
    laid_out = lay_out(program, "linear")
    assert (laid_out.channels, laid_out.count) == (3, 4)
    check(laid_out, light_of(program))
    cells = laid_out.code[: WIDTH * HEIGHT].reshape(HEIGHT, WIDTH, 3, 4)
    # the blocks of a pattern are 5 x 5 pixels
    np.testing.assert_array_equal(cells[2::5, 2::5], 255 * RGB.bits.transpose(1, 2, 3, 0))


def test_grey_pattern_among_coloured_ones_has_three_equal_channels() -> None:
    program = program_of(GREY, RGB)
    laid_out = lay_out(program, "linear")
    assert (laid_out.channels, laid_out.count) == (3, 9)
    check(laid_out, light_of(program))
    codes = laid_out.code.reshape(-1, 3, 9)
    np.testing.assert_array_equal(codes[:, 0, :5], codes[:, 1, :5])
    np.testing.assert_array_equal(codes[:, 0, :5], codes[:, 2, :5])
    assert (codes[:, 0, 5:] != codes[:, 1, 5:]).any()


@pytest.mark.parametrize("curve", ["srgb", Gamma(gamma=2.2), "linear"])
@pytest.mark.parametrize("colours", [1, 3])
def test_images_are_seen_through_the_monitors_curve(curve: Curve, colours: int) -> None:
    rng = np.random.default_rng(0)
    images = [rng.random((30, 40, colours), np.float32), rng.random((6, 10, 1), np.float32)]
    program = program_of(GREY, PHOTOGRAPHS)
    laid_out = lay_out(program, curve, images)
    assert (laid_out.channels, laid_out.count) == (colours, 7)
    check(laid_out, light_of(program, curve, images))


@pytest.mark.parametrize(
    ("room", "grid"), [(7 * 1500, (40, 30)), (7 * 1500 - 1, (20, 15)), (7 * 100, (10, 8)), (7, (1, 1))]
)
def test_with_little_room_cells_are_means_of_pixels(
    monkeypatch: pytest.MonkeyPatch, room: int, grid: tuple[int, int]
) -> None:
    rng = np.random.default_rng(0)
    images = [rng.random((30, 40, 1), np.float32), rng.random((7, 9, 1), np.float32)]
    program = program_of(GREY, PHOTOGRAPHS)
    monkeypatch.setattr(pyramid_light, "PATTERNS_BYTES", room)
    laid_out = lay_out(program, "srgb", images)
    assert laid_out.pyramid.grids[0] == grid
    assert laid_out.code.nbytes <= room
    check(laid_out, light_of(program, "srgb", images))


@pytest.mark.parametrize(("room", "grid"), [(18 * 1500, (40, 30)), (18 * 1500 - 1, (20, 15))])
def test_scaled_patterns_have_the_light_of_interpolated_pictures_but_images_do_not(
    monkeypatch: pytest.MonkeyPatch, room: int, grid: tuple[int, int]
) -> None:
    image = [np.random.default_rng(0).random((30, 40, 1), np.float32)] * 2
    program = program_of(RGB, CONSTANT, PHOTOGRAPHS)
    monkeypatch.setattr(pyramid_light, "PATTERNS_BYTES", room)
    light = light_of(program, "srgb", image).reshape(HEIGHT, WIDTH, 3, -1)
    for at in product(range(3), range(RGB.count)):
        light[:, :, *at] = interpolated_light(light[:, :, *at] > 0, "srgb")
    laid_out = lay_out(program, "srgb", image, scaled=True)
    assert laid_out.pyramid.grids[0] == grid
    check(laid_out, light.reshape(HEIGHT, WIDTH, -1))


@pytest.mark.parametrize("scaled", [False, True])
def test_a_large_monitor_takes_little_memory(monkeypatch: pytest.MonkeyPatch, scaled: bool) -> None:
    """Its pixels would take 1 GB for each channel, those of constant patterns and half-tones too."""
    monitor = Monitor(width=16384, height=16384)
    parts = (CONSTANT, Halftone(kind="halftone", levels=(0.25,)), MANY)
    monkeypatch.setattr(pyramid_light, "PATTERNS_BYTES", 1 << 23)
    tracemalloc.start()
    try:
        lay_out(Program(monitor=monitor, parts=parts), "srgb", scaled=scaled)
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()


def test_three_channels_take_three_times_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pyramid_light, "PATTERNS_BYTES", 4 * 1500)
    assert pyramid_of(program_of(RGB), 1).grids[0] == (40, 30)
    assert pyramid_of(program_of(RGB), 3).grids[0] == (20, 15)
