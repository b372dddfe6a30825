"""The backdrop around the glass."""

from typing import Any

import numpy as np
import pytest

from storage.errors import Conflict
from storage.layout import mattes
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from workflows.composite.backdrops.around import expose, over_frame, plate_of, put_around
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.backdrops.placement import Placement
from workflows.composite.engine import Window

WIDTH, HEIGHT = 8, 6
WHOLE = Window(0, 0, WIDTH, HEIGHT)
RAMP = np.repeat(np.linspace(0, 1, 16, dtype=np.float32)[np.newaxis, :, np.newaxis], 12, axis=0)
LARGER = [[1.5, 0, -0.25], [0, 2, -0.75], [0, 0, 1]]
"""A frame that sees a quarter of the monitor's width beyond either side, and more above it than below."""


@pytest.fixture
def matte(objects: Objects) -> Matte:
    """Of a frame that sees the monitor and no more."""
    return make(objects)


def make(objects: Objects, **attributes: Any) -> Matte:
    return mattes.create(
        objects, "m", height=HEIGHT, width=WIDTH, columns=4, rows=3, monitor=[16, 12], **attributes
    )


def glass() -> np.ndarray:
    """A composite of light 0.5 whose left half was left out."""
    picture = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    picture[:, 4:] = (0.5, 0.5, 0.5, 1)
    return picture


@pytest.mark.parametrize("placement", [None, Placement(right=0.25)])
def test_backdrop_stands_around_the_glass(matte: Matte, placement: Placement | None) -> None:
    found = put_around(matte, Backdrop(RAMP), placement, glass(), WHOLE)
    assert (found[..., 3] == 1).all()
    behind = RAMP[0, :, 0].reshape(8, 2).mean(axis=1)
    if placement:
        behind = np.concatenate([[0, 0], behind[:6]])
    np.testing.assert_allclose(found[:, :4, 0], np.tile(behind[:4], (6, 1)), atol=0.02)
    np.testing.assert_allclose(found[:, 4, 0], (2 * 0.5 + behind[4]) / 3, atol=0.02)  # mixed at the edge
    np.testing.assert_array_equal(found[:, 5:, :3], np.float32(0.5))


def test_backdrop_stands_where_the_camera_would_see_it(objects: Objects) -> None:
    matte = make(objects, beside={"sight": LARGER})
    found = put_around(matte, Backdrop(RAMP), None, glass(), WHOLE)[..., 0]
    assert (found[:2, :4] == 0).all()  # above the monitor
    assert (found[:, 0] == 0).all()  # beside it
    np.testing.assert_allclose(found[3, 2:4], np.interp([3.0, 6.0], np.arange(16), RAMP[0, :, 0]), atol=0.02)


def test_backdrop_over_the_frame_covers_all_that_it_sees(objects: Objects) -> None:
    matte = make(objects, beside={"sight": LARGER})
    covering = over_frame(matte, None)
    assert covering == Placement(0.0, -0.25, 2.0)
    assert (put_around(matte, Backdrop(RAMP + 0.1), covering, glass(), WHOLE)[:, :4] > 0).all()
    moved = over_frame(matte, Placement(right=0.1, scale=3, angle=20))
    assert moved == Placement(0.2, -0.25, 6.0, 20)


def test_backdrop_over_a_frame_within_the_monitor_covers_the_monitor(objects: Objects) -> None:
    matte = make(objects, beside={"sight": [[0.5, 0, 0.2], [0, 0.5, 0.2], [0, 0, 1]]})
    assert over_frame(matte, None) == Placement()


def test_a_frame_that_sees_the_monitor_and_no_more_changes_no_placement(matte: Matte) -> None:
    for placement in (None, Placement(right=0.25)):
        assert over_frame(matte, placement) == placement


def test_perspective_is_that_of_the_camera(objects: Objects) -> None:
    sight = np.array([[1.2, 0.1, -0.1], [0.0, 1.1, -0.05], [0.2, 0.1, 1.0]])
    matte = make(objects, beside={"sight": sight.tolist()})
    found = put_around(matte, Backdrop(RAMP), None, np.zeros((HEIGHT, WIDTH, 4), np.float32), WHOLE)[..., 0]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    u, v, depth = sight @ np.stack([x.ravel() / WIDTH, y.ravel() / HEIGHT, np.ones(x.size)])
    u, v = (u / depth).reshape(y.shape), (v / depth).reshape(y.shape)
    within = (np.abs(u - 0.5) < 0.4) & (np.abs(v - 0.5) < 0.4)
    assert within.sum() > 20
    np.testing.assert_allclose(
        found[within], np.interp(16 * u - 0.5, np.arange(16), RAMP[0, :, 0])[within], atol=0.02
    )


def test_clear_glass_shows_the_backdrop_in_its_own_colours(objects: Objects) -> None:
    crosstalk, rho = np.array([[1, 0.2, 0.05], [0.1, 0.9, 0.1], [0, -0.05, 1.1]]), np.array([0.5, 0.7, 0.6])
    beside = {"sight": LARGER, "rho": rho.tolist()}
    matte = make(objects, crosstalk=crosstalk.tolist(), beside=beside)
    light, alpha = np.random.default_rng(0).random((2, HEIGHT, WIDTH, 3), np.float32)
    taken = np.concatenate([(light * rho) @ crosstalk.T, alpha[..., :1]], axis=2).astype(np.float32)
    found = expose(matte, taken.copy())
    np.testing.assert_allclose(found[..., :3], light, atol=1e-5)
    np.testing.assert_array_equal(found[..., 3], alpha[..., 0])


def test_without_a_bare_monitor_a_picture_is_exposed_as_the_camera_did(matte: Matte) -> None:
    np.testing.assert_array_equal(expose(matte, glass()), glass())


@pytest.mark.parametrize("attributes", [{}, {"beside": {"sight": LARGER}}])
def test_crop_is_part_of_the_whole(objects: Objects, attributes: dict[str, Any]) -> None:
    matte = make(objects, **attributes)
    noise = Backdrop(np.random.default_rng(1).random((12, 16, 3), np.float32))
    whole = put_around(matte, noise, None, glass(), WHOLE)
    crop = np.ascontiguousarray(glass()[2:6, 1:4])
    np.testing.assert_array_equal(put_around(matte, noise, None, crop, Window(1, 2, 3, 4)), whole[2:6, 1:4])


def test_whole_glass_is_left_as_it_is(matte: Matte) -> None:
    picture = np.ones((HEIGHT, WIDTH, 4), np.float32)
    nothing = Backdrop(np.zeros((2, 2, 3), np.float32))
    assert put_around(matte, nothing, None, picture, WHOLE) is picture


def test_a_plate_needs_to_know_where_the_frame_sees_the_monitor(matte: Matte, objects: Objects) -> None:
    with pytest.raises(Conflict, match="recover it with cut_out"):
        plate_of(matte)
    beside = {"sight": LARGER, "rho": [0.5, 0.5, 0.5]}
    plate = plate_of(make(objects, crosstalk=np.eye(3).tolist(), beside=beside))
    np.testing.assert_allclose(plate.place @ LARGER, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(plate.exposure, 2 * np.eye(3))
    tiny = [[1 / 30, 0, 0], [0, 1 / 30, 0], [0, 0, 1]]
    with pytest.raises(Conflict, match="too little of the monitor"):
        plate_of(make(objects, beside={"sight": tiny, "rho": [1, 1, 1]}))
