"""The glass ball: its optics against closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.simulation.camera import CAMERA, MONITOR
from workflows.simulation.glass_ball import backdrop, glass_ball
from workflows.simulation.optics import fresnel
from workflows.simulation.scene import Scene


def centroids(scene: Scene, channel: int = 0) -> NDArray[np.float64]:
    """(height, width, 2): where each camera pixel's light comes from, in monitor pixels from the centre."""
    transport = scene.transport[channel].astype(np.float64)
    width, height = scene.monitor
    weight = np.maximum(np.asarray(transport.sum(axis=1)), 1e-9)
    rows = np.repeat(np.arange(transport.shape[0]), np.diff(transport.indptr))
    x = transport.indices % width + 0.5 - width / 2
    y = transport.indices // width + 0.5 - height / 2
    sums = [np.bincount(rows, transport.data * at, transport.shape[0]) for at in (x, y)]
    places: NDArray[np.float64] = np.stack(sums, axis=1) / weight[:, None]
    return places.reshape(scene.height, scene.width, 2)


@pytest.fixture(scope="module")
def ball() -> Scene:
    return glass_ball(48, 36, monitor=(96, 72), rays=16, index=(1.49, 1.5, 1.52), absorption=(0.1, 0.0, 0.3))


def test_fresnel_has_the_textbook_values() -> None:
    reflectance, refracted = fresnel(np.array([1.0]), 1.5)
    assert reflectance == pytest.approx(0.04)
    assert refracted == pytest.approx(1.0)
    # At Brewster's angle, tan i = n, the parallel half is not reflected; the refracted ray
    # and the reflected one would be at right angles.
    cosine = 1 / np.hypot(1, 1.5)
    reflectance, refracted = fresnel(np.array([cosine]), 1.5)
    assert refracted == pytest.approx(np.sqrt(1 - cosine**2))
    assert reflectance == pytest.approx(0.5 * ((1 - 1.5**2) / (1 + 1.5**2)) ** 2)


def test_a_surface_reflects_alike_from_both_sides() -> None:
    cosine = np.linspace(0.01, 1, 50)
    reflectance, refracted = fresnel(cosine, 1.5)
    back, through = fresnel(refracted, 1 / 1.5)
    np.testing.assert_allclose(back, reflectance, rtol=1e-9)
    np.testing.assert_allclose(through, cosine, rtol=1e-9)


def test_total_reflection_keeps_all_the_light() -> None:
    critical = np.sqrt(1 - (1 / 1.5) ** 2)
    reflectance, refracted = fresnel(np.linspace(0.001, critical - 1e-9, 50), 1 / 1.5)
    np.testing.assert_array_equal(reflectance, 1)
    np.testing.assert_array_equal(refracted, 0)


def test_a_bubble_reflects_all_beyond_the_critical_angle() -> None:
    scene = glass_ball(61, 61, monitor=(96, 96), rays=4, index=0.75)
    offset = np.abs(np.arange(61) - 30) * 2 / 61 / 0.85 / np.sqrt(CAMERA**2 - 1)
    sine = CAMERA * offset / np.hypot(1, offset)
    total = (sine > 0.75 + 0.04) & (sine < 1 - 0.04)
    assert np.count_nonzero(total) >= 6
    np.testing.assert_array_equal(scene.rho[30][total], 0)
    assert np.all(scene.rho[30][sine < 0.3] > 0.9)


def test_a_ball_of_no_refraction_is_not_seen() -> None:
    clear = glass_ball(48, 36, monitor=(960, 720), rays=16, index=1.0)
    np.testing.assert_allclose(clear.rho, 1, atol=1e-6)
    assert clear.coverage.max() == 1
    x = (np.arange(48) + 0.5 - 24) * (960 / 48 / 1.5)
    seen = centroids(clear)
    np.testing.assert_allclose(seen[..., 0], np.broadcast_to(x, (36, 48)), atol=1.5)
    np.testing.assert_allclose(seen[..., 1], np.broadcast_to(x[6:42, None], (36, 48)), atol=1.5)


def test_no_light_is_made(ball: Scene) -> None:
    assert ball.rho.shape == (36, 48, 3)
    assert ball.rho.dtype == np.float32
    assert ball.rho.max() <= 1 + 1e-6
    np.testing.assert_allclose(ball.rho[ball.coverage == 0], 1, atol=1e-6)
    assert ball.rho[ball.coverage == 1].max() < 0.93
    assert ball.coverage[18, 24] == 1
    assert 0.5 < np.count_nonzero(ball.object_mask) / np.count_nonzero(ball.coverage > 0.5) <= 1
    assert not np.any(ball.object_mask & (ball.coverage <= 0.5))


@pytest.mark.parametrize("bounces", [0, 8])
def test_the_middle_transmits_what_fresnel_says(bounces: int) -> None:
    scene = glass_ball(61, 61, monitor=(96, 96), rays=4, index=1.6, bounces=bounces)
    reflectance = (0.6 / 2.6) ** 2
    # Light passes two surfaces; of every two inner reflections the remainder leaves forward again:
    # (1 - R)^2 (1 + R^2 + R^4 + ...) = (1 - R) / (1 + R).
    forward = (1 - reflectance) / (1 + reflectance) if bounces else (1 - reflectance) ** 2
    np.testing.assert_allclose(scene.rho[30, 30], forward, rtol=1e-5)


def test_a_tint_follows_beer_and_lambert() -> None:
    clear = glass_ball(61, 61, monitor=(96, 96), rays=4, bounces=0)
    tinted = glass_ball(61, 61, monitor=(96, 96), rays=4, bounces=0, absorption=(0.0, 0.2, 0.5))
    left = tinted.rho[30, 30] / clear.rho[30, 30]
    np.testing.assert_allclose(left, np.exp([0.0, -0.4, -1.0]), rtol=1e-3)
    assert clear.transport[0] is clear.transport[2]
    assert tinted.transport[0] is not tinted.transport[2]


def test_a_ball_inverts_what_is_behind_it() -> None:
    scene = glass_ball(61, 61, monitor=(480, 480), rays=16)
    seen = centroids(scene)
    np.testing.assert_allclose(seen[30, 30], 0, atol=2)
    assert seen[30, 24, 0] > 5
    assert seen[30, 36, 0] < -5
    assert seen[24, 30, 1] > 5
    assert seen[36, 30, 1] < -5
    assert seen[30, 1, 0] < -100
    assert seen[1, 30, 1] < -100


def test_near_the_axis_a_ball_is_the_ball_lens() -> None:
    size = {"width": 161, "height": 121, "monitor": (6400, 4800), "rays": 64, "bounces": 0}
    index = (1.45, 1.5, 1.55)
    scene, bare = glass_ball(index=index, **size), glass_ball(index=1.0, **size)  # type: ignore[arg-type]
    direct = centroids(bare)[60, 83, 0]
    for channel, n in enumerate(index):
        # A thin lens of focal length n / (2 (n - 1)) radii at the ball's centre.
        focal = n / (2 * (n - 1))
        magnified = (CAMERA + MONITOR * (1 - CAMERA / focal)) / (CAMERA + MONITOR)
        seen = centroids(scene, channel)[60, 83, 0]
        assert seen / direct == pytest.approx(magnified, rel=0.02)


def test_off_the_axis_a_ray_is_turned_twice() -> None:
    scene = glass_ball(101, 101, monitor=(3000, 3000), rays=64, bounces=0)
    slope = (np.arange(51, 101) - 50) * 2 / 101 / 0.85 / np.sqrt(CAMERA**2 - 1)
    angle = np.arctan(slope)
    distance = CAMERA * np.sin(angle)
    inner = distance < 0.8
    angle, distance = angle[inner], distance[inner]
    # The ray leaves at its old distance from the ball's centre, turned by twice the difference of its angles.
    turned = angle - 2 * (np.arcsin(distance) - np.arcsin(distance / 1.5))
    landing = (distance + MONITOR * np.sin(turned)) / np.cos(turned)
    radius = 1500 / (1.5 * (CAMERA + MONITOR) / 0.85 / np.sqrt(CAMERA**2 - 1))
    np.testing.assert_allclose(centroids(scene)[50, 51:, 0][inner], landing * radius, atol=1)


def test_the_backdrop_is_light_of_many_colours() -> None:
    light = backdrop(320, 240, seed=1)
    assert light.shape == (240, 320, 3)
    assert light.dtype == np.float32
    assert light.min() >= 0
    assert light.max() <= 1
    assert light.std(axis=(0, 1)).min() > 0.15
    np.testing.assert_array_equal(light, backdrop(320, 240, seed=1))
    assert np.any(light != backdrop(320, 240, seed=2))
