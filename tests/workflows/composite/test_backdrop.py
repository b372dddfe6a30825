"""The light of a backdrop at the nodes of T, against what numpy makes of it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.workflows.composite import peak
from workflows.composite.backdrop import Backdrop, node_light
from workflows.composite.placement import Placement
from workflows.images.resample import area_mean
from workflows.images.tone_curves import table
from workflows.recovery.pyramid import Pyramid

COLUMNS, ROWS = 80, 60
MONITOR = (1280, 960)


def cells(picture: NDArray[np.float32], **placement: float) -> NDArray[np.float32]:
    """The light of the first grid."""
    light = node_light(Backdrop(picture), COLUMNS, ROWS, 2, Placement(**placement), MONITOR)
    return light[: COLUMNS * ROWS].reshape(ROWS, COLUMNS, 3)


@pytest.fixture
def smooth() -> NDArray[np.float32]:
    y, x = np.mgrid[0:120, 0:160] / 40
    return np.stack([0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.5 + 0.2 * np.sin(x + y)], axis=2).astype(
        np.float32
    )


@pytest.mark.parametrize("size", [(60, 80), (120, 160), (31, 47), (200, 333), (1, 1), (1, 500), (997, 3)])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("threads", [1, 3])
def test_it_is_the_mean_over_cells_and_that_of_coarser_grids(
    size: tuple[int, int], channels: int, threads: int
) -> None:
    picture = np.random.default_rng(0).random((*size, channels), np.float32)
    found = node_light(Backdrop(picture), COLUMNS, ROWS, threads)
    expected = Pyramid.over(COLUMNS, ROWS).light(area_mean(picture, COLUMNS, ROWS))
    assert (found[-1] == 0).all()
    np.testing.assert_allclose(found[:-1], np.broadcast_to(expected, (len(found) - 1, 3)), atol=2e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codes_are_looked_up(dtype: type) -> None:
    codes = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (30, 40, 3), dtype, endpoint=True)
    light = table("srgb", np.dtype(dtype))
    found = node_light(Backdrop(codes, light), COLUMNS, ROWS, 2)
    np.testing.assert_array_equal(found, node_light(Backdrop(light[codes]), COLUMNS, ROWS, 2))


def test_a_backdrop_may_stay_where_it_is(smooth: NDArray[np.float32]) -> None:
    np.testing.assert_allclose(cells(smooth), area_mean(smooth, COLUMNS, ROWS), atol=0.01)


def test_a_backdrop_moves_right_and_down(smooth: NDArray[np.float32]) -> None:
    there, moved = cells(smooth), cells(smooth, right=0.25, down=0.1)
    np.testing.assert_allclose(moved[6:, 20:], there[:-6, :-20], atol=0.01)
    assert (moved[:6] == 0).all()
    assert (moved[:, :20] == 0).all()


def test_a_backdrop_turns_clockwise_on_square_pixels() -> None:
    picture = np.zeros((96, 128, 1), np.float32)
    picture[:, 64:] = 1  # the right half of the monitor, turned down to its lower half, as far as it reaches
    turned = cells(picture, angle=90)[..., 0]
    middle = turned[:, 10:70]  # a monitor of 4 to 3 on its side is 3/4 as wide as it was
    assert (middle[32:] == 1).all()
    assert (middle[:28] == 0).all()
    assert (turned[:, :9] == 0).all()
    assert (turned[:, -9:] == 0).all()


def test_a_backdrop_shrinks_about_its_centre_without_aliasing() -> None:
    checker = (np.indices((480, 640)).sum(axis=0) % 2).astype(np.float32)[..., np.newaxis]
    small = cells(checker, scale=0.5)[..., 0]
    np.testing.assert_allclose(small[17:43, 22:58], 0.5, atol=0.01)
    assert (small[:14] == 0).all()
    assert (small[:, :19] == 0).all()
    np.testing.assert_allclose(cells(checker, scale=0.5, angle=30)[28:32, 38:42], 0.5, atol=0.02)


def test_a_backdrop_grows_about_its_centre(smooth: NDArray[np.float32]) -> None:
    np.testing.assert_allclose(cells(smooth, scale=2), area_mean(smooth[30:90, 40:120], 80, 60), atol=0.01)


@pytest.mark.parametrize("placement", [{}, {"scale": 0.3, "angle": 20}])
def test_threads_change_nothing(placement: dict[str, float]) -> None:
    backdrop = Backdrop(np.random.default_rng(0).random((300, 211, 3), np.float32))
    one, four = (
        node_light(backdrop, 200, 150, threads, Placement(**placement), MONITOR) for threads in (1, 4)
    )
    np.testing.assert_array_equal(one, four)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(
    "placement", [{"scale": 1.0}, {"scale": 0.3, "angle": 20}, {"scale": 5, "angle": 20}]
)
def test_a_placed_backdrop_of_codes_is_as_one_of_their_light(
    channels: int, placement: dict[str, float]
) -> None:
    codes = np.random.default_rng(0).integers(0, 256, (150, 200, channels), np.uint8)
    light = table("srgb", np.dtype(np.uint8))
    picture = light[codes[..., :3]]
    if channels == 4:
        picture *= codes[..., 3:] / np.float32(255)
    found, expected = (
        node_light(one, COLUMNS, ROWS, 2, Placement(**placement), MONITOR)
        for one in (Backdrop(codes, light), Backdrop(picture))
    )
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("placement", [{"scale": 47}, {"scale": 47, "angle": 30, "right": 15, "down": -12}])
def test_what_is_seen_of_an_enlarged_backdrop_is_as_if_all_of_it_were_held(
    placement: dict[str, float],
) -> None:
    picture = np.random.default_rng(0).random((3000, 4000, 1), np.float32)
    found = cells(picture, **placement)[..., 0]
    # of pixels that are as large as cells, about, as it is made first
    turned = Placement(**placement).matrix((COLUMNS, ROWS), MONITOR, (4000, 3000))
    steps = np.hypot(*turned[:, :2].T)
    assert (steps > 1).all()
    wide, high = (int(np.ceil(size / step)) for size, step in zip((4000, 3000), steps, strict=True))
    np.testing.assert_allclose(found, cells(area_mean(picture, wide, high), **placement)[..., 0], atol=1e-5)
    assert found.std() > 0.05


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        ((3000, 4000, 3), "uint8"),
        ((3000, 4000, 4), "uint8"),
        ((2000, 3000, 3), "uint16"),
        ((2000, 3000, 1), "float32"),
    ],
)
def test_a_large_backdrop_takes_little_memory_beside_its_own(shape: tuple[int, int, int], dtype: str) -> None:
    size, grown = peak.of_large_after_small(shape, dtype)
    assert grown < size / 2
