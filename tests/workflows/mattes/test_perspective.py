"""Where pixels look beside an object, by what those of a bare monitor around it see."""

import numpy as np
import pytest

from workflows.mattes.perspective import Places, find_perspective, find_sight, sights

HEIGHT, WIDTH, ASPECT = 90, 120, 0.75
ASKEW = np.array([[0.7, 0.05, 0.5], [-0.04, 0.72, 0.48], [0.08, -0.05, 1.0]])
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
ACROSS, DOWN = (2 * X + 1) / WIDTH - 1, (2 * Y + 1) / HEIGHT - 1


def places_before(barrel: float = 0.0, radius: float = 0.6, noise: float = 3e-4) -> tuple[Places, np.ndarray]:
    """What pixels see of a monitor askew, through a lens that bends lines, with a glass ball before it that inverts;
    and where they would look without the ball.
    """
    bent = 1 - barrel * (ACROSS**2 + DOWN**2)
    sight = sights(ASKEW, ACROSS * bent, DOWN * bent)
    rng = np.random.default_rng(1)
    places = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    ball = np.hypot(ACROSS, DOWN * 0.75) < radius
    seen = np.where(ball[..., np.newaxis], 0.5 - 0.8 * (sight - 0.5), sight)
    places[..., :2] = seen + noise * rng.standard_normal(seen.shape)
    places[..., 2], places[..., 3] = 0.004, 0.97
    outside = ((sight < 0) | (sight > 1)).any(axis=2)
    # What a dark room seems to see.
    places[outside] = rng.random((np.count_nonzero(outside), 4)) * (1, 1, 0.1, 0.7)
    return places, sight


@pytest.mark.parametrize("radius", [0.2, 0.6])
def test_the_perspective_is_that_of_the_bare_monitor(radius: float) -> None:
    places, sight = places_before(radius=radius)
    found = find_perspective(places, ACROSS, DOWN, ASPECT)
    assert found is not None
    inside = ((sight > 0) & (sight < 1)).all(axis=2)
    off = np.hypot(*np.moveaxis(sights(found, ACROSS, DOWN) - sight, 2, 0))
    assert off[inside].max() < 1e-3


def test_a_lens_that_bends_lines_is_followed() -> None:
    places, sight = places_before(barrel=0.02)
    inside = ((sight > 0) & (sight < 1)).all(axis=2)
    found = find_sight(places, Y, X, (HEIGHT, WIDTH), ASPECT)
    straight = find_perspective(places, ACROSS, DOWN, ASPECT)
    assert found is not None
    assert straight is not None
    off, without = (
        np.hypot(*np.moveaxis(at - sight, 2, 0))[inside].max()
        for at in (found.at(Y, X), sights(straight, ACROSS, DOWN))
    )
    assert off < 2e-3 < without


def test_without_a_bare_monitor_there_is_no_perspective() -> None:
    assert find_perspective(np.zeros((HEIGHT, WIDTH, 4), np.float32), ACROSS, DOWN, ASPECT) is None
    rng = np.random.default_rng(0)
    anywhere = np.full((HEIGHT, WIDTH, 4), 0.01, np.float32)
    anywhere[..., :2], anywhere[..., 3] = rng.random((HEIGHT, WIDTH, 2)), 1
    assert find_perspective(anywhere, ACROSS, DOWN, ASPECT) is None
