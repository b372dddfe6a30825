"""Backdrops at another depth than the monitor's, against scenes traced there."""

import numpy as np
import pytest
import scipy.sparse as sp

from storage.errors import Conflict
from storage.layout.mattes import Block, Matte, create
from storage.objects.store import Objects
from workflows.composite import composite
from workflows.composite.depth import Rays, from_one, from_two
from workflows.composite.engine import Window
from workflows.images.resample import area_mean
from workflows.mattes.perspective import places_of
from workflows.simulation import glass_ball
from workflows.simulation.scene import Scene
from workflows.threads import CORES

WIDTH, HEIGHT = 96, 72
COLUMNS, ROWS = 320, 240
NEAR, FAR, BEYOND = 3.0, 4.0, 3.6


def exact(objects: Objects, name: str, scene: Scene) -> Matte:
    """The matte that a scene's exact transport makes, on a grid."""
    matte = create(
        objects,
        name,
        height=HEIGHT,
        width=WIDTH,
        columns=COLUMNS,
        rows=ROWS,
        monitor=[1280, 960],
        crosstalk=np.eye(3).tolist(),
    )
    fine = scene.transport[0].tocsr()
    y, x = np.divmod(fine.indices, 1280)
    cells = (y * ROWS // 960) * COLUMNS + x * COLUMNS // 1280
    rows = sp.csr_array((fine.data, cells, fine.indptr), shape=(HEIGHT * WIDTH, COLUMNS * ROWS))
    rows.sum_duplicates()
    rho = np.asarray(rows.sum(axis=1), np.float32).reshape(HEIGHT, WIDTH)
    for row in range(matte.block_rows):
        for column in range(matte.block_columns):
            at = matte.span(row, column)
            pixels = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)[at]
            part = rows[pixels.ravel()]
            count = np.zeros((*pixels.shape, 3), np.uint32)
            count[..., 0] = np.diff(part.indptr).reshape(pixels.shape)
            sums = np.maximum(np.repeat(rho[at].ravel(), np.diff(part.indptr)), 1e-9)
            whole = np.repeat(rho[at][..., np.newaxis], 3, axis=2)
            seen = np.ones(pixels.shape, bool)
            error = np.zeros(pixels.shape, np.float32)
            cells, weights = part.indices.astype(np.uint32), (part.data / sums).astype(np.float32)
            matte.write(row, column, Block(whole * 0, whole, error, seen, seen, count, cells, weights))
    return matte


@pytest.fixture(scope="module")
def backdrop() -> np.ndarray:
    y, x = np.mgrid[:480, :640] / 480
    return np.stack(
        [0.5 + 0.4 * np.sin(14 * x), 0.5 + 0.4 * np.cos(11 * y), 0.5 + 0.4 * np.sin(9 * (x + y))], 2
    ).astype(np.float32)


@pytest.fixture(scope="module")
def scenes() -> dict[float, Scene]:
    return {at: glass_ball.glass_ball(WIDTH, HEIGHT, rays=25, distance=at) for at in (NEAR, FAR, BEYOND)}


@pytest.fixture(scope="module")
def made(scenes: dict[float, Scene], tmp_path_factory: pytest.TempPathFactory) -> dict[float, Matte]:
    objects = Objects(tmp_path_factory.mktemp("store").as_uri())
    return {at: exact(objects, f"at{at}", scenes[at]) for at in (NEAR, FAR)}


def psnr(scene: Scene, seen: np.ndarray, backdrop: np.ndarray, where: np.ndarray) -> float:
    error = seen[..., :3] - scene.truth(area_mean(backdrop, 1280, 960), offset=0, gain=1)
    return float(-10 * np.log10(np.mean(error[where] ** 2)))


@pytest.mark.slow
def test_second_matte_gives_the_rays(
    made: dict[float, Matte], scenes: dict[float, Scene], backdrop: np.ndarray
) -> None:
    first, second = (places_of(made[at], CORES) for at in (NEAR, FAR))
    scene, where = scenes[BEYOND], scenes[BEYOND].object_mask
    still = psnr(scene, composite(made[NEAR], backdrop), backdrop, where)
    moved = psnr(
        scene,
        composite(made[NEAR], backdrop, rays=from_two(first, second, (NEAR, FAR), BEYOND)),
        backdrop,
        where,
    )
    print(f"at {BEYOND}: {moved:.1f} dB, {still:.1f} dB as if it stood at {NEAR}")
    assert moved > 30
    assert moved > still + 10


def test_pixels_that_see_other_light_in_the_second_matte_follow_the_others() -> None:
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32) / WIDTH
    plane = np.stack([0.2 + 0.5 * x, 0.1 + 0.6 * y], axis=2)
    slope = np.stack([0.05 * y, -0.04 * x], axis=2)
    sure = np.ones((HEIGHT, WIDTH, 2), np.float32)
    first, second = (np.concatenate([plane + at * slope, sure], axis=2) for at in (NEAR, FAR))
    second[10:14, 20:30, :2] += 5  # a reflection
    rays = from_two(first, second, (NEAR, FAR), BEYOND)
    assert rays.scale == pytest.approx(BEYOND / NEAR)
    np.testing.assert_allclose(rays.shift, plane * (1 - rays.scale), atol=1e-4)
    second[..., 3] = 0
    second[:3, :5, 3] = 1
    with pytest.raises(Conflict, match="too few pixels"):
        from_two(first, second, (NEAR, FAR), BEYOND)


def test_one_matte_gives_the_rays_by_the_camera_s_lines_of_sight(
    made: dict[float, Matte], scenes: dict[float, Scene], backdrop: np.ndarray
) -> None:
    places = places_of(made[NEAR], CORES)
    rays = from_one(places, 0.75, NEAR, glass_ball.CAMERA, BEYOND)
    scene = scenes[BEYOND]
    beside = scene.coverage == 0
    seen, still = composite(made[NEAR], backdrop, rays=rays), composite(made[NEAR], backdrop)
    # What is seen directly is exact; a ball is thick, and its light moves sideways in it.
    assert psnr(scene, seen, backdrop, beside) > 35
    assert psnr(scene, still, backdrop, beside) < 25
    where = scene.object_mask
    through, as_if = psnr(scene, seen, backdrop, where), psnr(scene, still, backdrop, where)
    print(f"at {BEYOND}: {through:.1f} dB through the ball, {as_if:.1f} dB as if it stood at {NEAR}")
    assert through > as_if


def test_at_the_monitor_s_own_depth_nothing_moves(made: dict[float, Matte], backdrop: np.ndarray) -> None:
    matte = made[NEAR]
    places = places_of(matte, CORES)
    still = composite(matte, backdrop)
    others = places_of(made[FAR], CORES)
    for rays in (from_one(places, 0.75, NEAR, 5.0, NEAR), from_two(places, others, (NEAR, FAR), NEAR)):
        np.testing.assert_allclose(composite(matte, backdrop, rays=rays), still, atol=2e-3)


def test_a_window_at_another_depth_is_a_piece_of_the_whole(
    made: dict[float, Matte], backdrop: np.ndarray
) -> None:
    matte = made[NEAR]
    rays = from_one(places_of(matte, 1), 0.75, NEAR, 5.0, 5.0)
    whole = composite(matte, backdrop, rays=rays)
    window = Window.of(matte, 13, 7, 50, 41)
    np.testing.assert_array_equal(composite(matte, backdrop, rays=rays, window=window), whole[7:48, 13:63])


def test_beyond_a_backdrop_that_is_far_away_it_is_black(
    made: dict[float, Matte], backdrop: np.ndarray
) -> None:
    matte = made[NEAR]
    away = Rays(np.full((HEIGHT, WIDTH, 2), 2, np.float32), 1.0)
    assert (composite(matte, backdrop, rays=away)[..., :3] == 0).all()


def test_without_a_bare_monitor_the_camera_is_not_known() -> None:
    places = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    with pytest.raises(Conflict, match="bare monitor"):
        from_one(places, 0.75, 3, 5, 4)
    rng = np.random.default_rng(0)
    places[..., :2], places[..., 2:] = rng.random((HEIGHT, WIDTH, 2)), (0.01, 1)
    with pytest.raises(Conflict, match="bare monitor"):
        from_one(places, 0.75, 3, 5, 4)
