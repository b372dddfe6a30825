"""Cameras of the benchmark: what each keeps of the light."""

import numpy as np
import pytest
import scipy.sparse as sp

from tests.benchmarks.field.cameras import CAMERAS, Seen
from workflows.programs.parts import Constant, Images, Monitor
from workflows.programs.program import Program

SIZE = 16, 12
SPOT = 7 * SIZE[0] + 7
LEVELS = (0.0, 0.5, 1.0)


def seen(camera: str, **more: float) -> Seen:
    """A scene whose pixels see one of the monitor's each, but for one that sees none."""
    T = sp.eye_array(SIZE[0] * SIZE[1], dtype=np.float32, format="csr")
    T.data[SPOT] = 0
    coverage = np.ones(SIZE[::-1], np.float32)
    return Seen(*SIZE, SIZE, (T, T, T), coverage, lens=CAMERAS[camera], **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_keeps_the_light_of_even_surfaces(name: str) -> None:
    camera, scene = CAMERAS[name], seen(name)
    monitor = Monitor(width=SIZE[0], height=SIZE[1], response="linear")
    files = tuple(f"{level}.png" for level in LEVELS)
    parts = (Constant(kind="constant", levels=(0, 1)), Images(kind="images", files=files))
    images = [np.full((*SIZE[::-1], 1), level, np.float32) for level in LEVELS]
    filmed = scene.film(
        Program(monitor=monitor, parts=parts),
        noise=0,
        depth=camera.depth,
        response=camera.response,
        images=images,
    )
    for level, frame in zip(LEVELS, list(filmed)[2:], strict=True):
        light = scene.truth(np.full((1, 1, 1), level, np.float32))
        away = np.s_[:3, -3:]  # from the dark pixel
        np.testing.assert_allclose(camera.values(frame)[away], light[away], atol=0.02)


@pytest.mark.parametrize("name", ["RAW", "phone"])
def test_a_lens_blurs_and_veils_what_is_dark(name: str) -> None:
    white = np.ones((1, 1, 3), np.float32)
    dark = seen("linear").composite(white).reshape(-1, 3)[SPOT]
    assert (dark == 0).all()
    veiled = seen(name).composite(white).reshape(-1, 3)[SPOT]
    assert (veiled > 0.5).all()


def test_frost_spreads_what_a_pixel_sees() -> None:
    point = np.zeros((*SIZE[::-1], 1), np.float32)
    point[4, 4] = 1
    clear, frosted = (seen("linear", frost=frost).composite(point)[..., 0] for frost in (0.0, 1.5))
    assert np.count_nonzero(clear) == 1
    assert np.count_nonzero(frosted > 0.01) > 9
    assert frosted.sum() == pytest.approx(1, abs=0.1)
