"""The tracer of solids: its optics against closed forms, and against the glass ball."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.workflows.simulation.test_glass_ball import centroids
from workflows.simulation.camera import CAMERA, MONITOR, Camera
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.objects import lens, stone, tumbler, window
from workflows.simulation.optics import fresnel
from workflows.simulation.solids import Convex, Solid, turned
from workflows.simulation.tracer import through, trace

SOLIDS = {"lens": lens(), "tumbler": tumbler(), "stone": stone()}
BALL = Solid(Convex(centres=np.zeros((1, 3)), axes=np.ones((1, 3))))
SMALL = Camera(48, 36, (96, 72), 16)
AHEAD = np.array([[0.0], [0.0], [1.0]])


def white(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """A room as bright as the monitor."""
    return np.ones(direction.shape[1])


@pytest.mark.parametrize("name", SOLIDS)
def test_no_light_is_made_and_little_is_lost(name: str) -> None:
    scene = trace(SOLIDS[name], SMALL, surfaces=12, room=white)
    assert scene.reflections is not None
    arrived = scene.rho + scene.reflections
    assert arrived.max() <= 1 + 1e-5
    assert arrived.mean() > 0.98
    assert arrived[scene.coverage == 0].min() > 1 - 1e-5
    tinted = trace(SOLIDS[name], SMALL, surfaces=12, room=white, absorption=(0.2, 0.0, 1.0))
    assert tinted.reflections is not None
    lit = (tinted.rho + tinted.reflections)[scene.coverage == 1]
    assert np.all(np.diff(lit.mean(axis=0)[[2, 0, 1]]) > 0.02)


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_of_no_refraction_is_not_seen(name: str) -> None:
    clear, bare = trace(SOLIDS[name], SMALL, index=1.0), trace(BALL, SMALL, index=1.0)
    assert 0.1 < clear.coverage.mean() < bare.coverage.mean()
    np.testing.assert_allclose(clear.rho, 1, atol=1e-6)
    np.testing.assert_allclose(centroids(clear), centroids(bare), atol=1e-6)


def test_ball_agrees_with_the_glass_ball() -> None:
    glass = {"index": (1.49, 1.5, 1.52), "absorption": (0.1, 0.0, 0.3)}
    traced = trace(BALL, SMALL, surfaces=6, **glass)  # type: ignore[arg-type]
    known = glass_ball(48, 36, monitor=(96, 72), rays=16, bounces=4, **glass)  # type: ignore[arg-type]
    np.testing.assert_array_equal(traced.coverage, known.coverage)
    y, x = np.mgrid[:36, :48]
    off = np.hypot(x + 0.5 - 24, y + 0.5 - 18) / 18 / 0.85
    # At its edge the outside mirrors the monitor, which `glass_ball` leaves out.
    inner = (off < 0.9) | (off > 1.1)
    light = backdrop(96, 72)
    np.testing.assert_allclose(traced.composite(light)[inner], known.composite(light)[inner], atol=2e-3)


def test_near_the_axis_a_lens_follows_paraxial_optics() -> None:
    size = {"width": 161, "height": 121, "monitor": (6400, 4800), "rays": 16}
    camera, thickness = Camera(**size), 0.3  # type: ignore[arg-type]
    direct = centroids(trace(BALL, camera, index=1.0))[60, 83, 0]
    index = (1.45, 1.5, 1.6)
    scene = trace(lens(thickness), camera, index=index, surfaces=2)
    radius = (1 + thickness**2 / 4) / thickness

    def gap(length: float) -> NDArray[np.float64]:
        return np.array([[1, length], [0, 1]])

    for channel, n in enumerate(index):
        # Matrices of (distance from the axis, slope); at each surface the slope changes by Snell's law.
        enter = np.array([[1, 0], [-(1 - 1 / n) / radius, 1 / n]])
        leave = np.array([[1, 0], [-(n - 1) / radius, n]])
        bare = thickness / 2
        way = gap(MONITOR - bare) @ leave @ gap(thickness) @ enter @ gap(CAMERA - bare)
        seen = centroids(scene, channel)[60, 83, 0]
        assert seen / direct == pytest.approx(way[0, 1] / (CAMERA + MONITOR), rel=0.02)


@pytest.mark.parametrize("degrees", [0, 20, 50])
def test_slab_shifts_rays_and_keeps_their_direction(degrees: float) -> None:
    thickness, index = 0.7, 1.5
    planes = Convex(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), np.full(2, thickness / 2))
    slab = Solid(planes, turn=turned(("y", degrees)))
    hit, ends = through(AHEAD, index, 0.0, slab, 2)
    assert hit.all()
    ((_, point, direction, weight),) = [end for end in ends if end[3].size and end[3][0] > 0.5]
    np.testing.assert_allclose(direction, AHEAD, atol=1e-12)
    angle = np.radians(degrees)
    inner = np.arcsin(np.sin(angle) / index)
    shift = thickness * np.sin(angle - inner) / np.cos(inner)
    np.testing.assert_allclose(np.hypot(*point[:2]), shift, atol=1e-12)
    reflectance, _ = fresnel(np.array([np.cos(angle)]), index)
    np.testing.assert_allclose(weight, (1 - reflectance) ** 2)


@pytest.mark.parametrize(("index", "total"), [(1.4, False), (1.6, True)])
def test_stone_reflects_all_light_beyond_the_critical_angle(index: float, total: bool) -> None:
    # From above the table, light meets the pavilion at about 41 degrees.
    upright = replace(stone(), turn=turned(("x", 180)))
    ray = np.array([[0.03], [0.0], [1.0]])
    _, ends = through(ray / np.linalg.norm(ray), index, 0.0, upright, 2)
    passed = sum(
        float(weight.sum()) for *_, direction, weight in ends if direction.size and direction[2, 0] > 0
    )
    assert (passed == 0) is total


def test_tint_follows_the_way_through_the_walls() -> None:
    upright = replace(tumbler(), turn=np.eye(3))
    _, ends = through(AHEAD, 1.0, 0.5, upright, 4)
    outer, inner = (
        radius * np.sqrt(1 - (0.73 / height) ** 2) for radius, height in ((0.68, 2.4), (0.61, 2.3))
    )
    (left,) = [float(weight[0]) for *_, weight in ends if weight.size]
    assert left == pytest.approx(np.exp(-0.5 * 2 * (outer - inner)))


def test_room_is_mirrored_and_the_window_is_in_it() -> None:
    scene = trace(BALL, SMALL, room=window)
    assert scene.reflections is not None
    assert scene.reflections[scene.coverage == 0].max() < 1e-6
    # The outside mirrors it where the normal halves the angle between it and the camera: above and to the left.
    assert scene.reflections[11:15, 17:22].max() > 0.02
    assert scene.reflections[11:15, 26:31].max() < 0.01
    darkest = scene.truth(np.zeros((1, 1, 1), np.float32), offset=0.1)
    np.testing.assert_allclose(darkest, 0.1 + scene.reflections, atol=1e-6)
