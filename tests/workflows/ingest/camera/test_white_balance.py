"""A white balance that changes while the patterns are shown is found by their colours, and undone."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout.captures import Stack
from tests.parts.captures import captured, nested_program
from workflows.images.tone_curves import to_light
from workflows.ingest.camera.white_balance import fit_white_balance
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball

Doubles = NDArray[np.float64]
PROGRAM = nested_program((160, 120), bands=((8, 6, 16), (16, 12, 16), (32, 24, 16)), levels=2)
PIXELS = 400
TINT = np.array([0.9, 0.6, 0.4])
NONE = np.ones((PROGRAM.count, 3))


def warmer() -> Doubles:
    """A step after half of the frames."""
    late = np.arange(PROGRAM.count) >= PROGRAM.count // 2
    return np.where(late[:, np.newaxis], [1.06, 1.0, 0.94], 1.0)


def slowly() -> Doubles:
    """Red drifts by a tenth."""
    return np.stack([np.linspace(1, 1.1, PROGRAM.count), NONE[:, 0], NONE[:, 0]], axis=1)


def fitted(gains: Doubles, clipped: bool = False) -> Doubles | None:
    """What is found of tinted glass if all light of a frame is times the gains of its channels."""
    random = np.random.default_rng(5)
    share = random.uniform(0, 1, (PROGRAM.count, PIXELS, 1)).round() * 0.9 + 0.05
    share[:2] = np.arange(2)[:, np.newaxis, np.newaxis]
    share = share + 0.02 * random.standard_normal((PROGRAM.count, PIXELS, 3)) * (share % 1 > 0)  # dispersion
    rho = TINT * random.uniform(0.5, 1, (PIXELS, 1))
    light = (gains[:, np.newaxis] * (0.02 + rho * share)).astype(np.float32)
    whole = np.ones(light.shape, bool)
    if clipped:
        whole = light < 0.8
        light = np.minimum(light, 0.8)
    return fit_white_balance(light, whole, np.arange(PROGRAM.count), PROGRAM)


@pytest.mark.parametrize("gains", [warmer(), slowly()])
def test_changed_white_balance_is_found(gains: Doubles) -> None:
    np.testing.assert_allclose(fitted(gains), gains, atol=0.015)


def test_what_was_known_is_added() -> None:
    light = np.ones((PROGRAM.count, PIXELS, 3), np.float32)
    light[0] = 0
    whole = np.ones(light.shape, bool)
    found = fit_white_balance(light, whole, np.arange(PROGRAM.count), PROGRAM, warmer())
    np.testing.assert_allclose(found, warmer(), rtol=1e-6)


def test_clipped_values_do_not_count() -> None:
    found = fitted(warmer(), clipped=True)
    np.testing.assert_allclose(found, warmer(), atol=0.015)


def test_light_that_flickers_in_all_channels_is_no_white_balance() -> None:
    light = np.random.default_rng(1).uniform(0.9, 1.1, (PROGRAM.count, 1))
    assert fitted(light * NONE) is None


def test_single_coloured_frames_are_no_white_balance() -> None:
    gains = NONE.copy()
    gains[[9, 25], 0] = 1.3
    assert fitted(gains) is None


def test_without_black_or_white_there_is_none() -> None:
    light = np.ones((PROGRAM.count - 1, PIXELS, 3), np.float32)
    patterns = np.arange(1, PROGRAM.count)
    assert fit_white_balance(light, np.ones(light.shape, bool), patterns, PROGRAM, NONE[1:]) is None


@pytest.mark.parametrize("colour", ["grey", "rgb"])
def test_recovery_follows_it_unless_patterns_are_in_colour(ingest: Callable[..., Stack], colour: str) -> None:
    record = PROGRAM.model_dump()
    for part in record["parts"][1:]:
        part["colour"] = colour
    program, gains = Program.model_validate(record), warmer()
    scene = glass_ball(80, 60, monitor=(160, 120), rays=4)
    random = np.random.default_rng(5)

    def see(n: int, picture: NDArray[np.uint8]) -> NDArray[np.floating]:
        value = gains[n] * (0.02 + 0.8 * TINT * scene.composite(to_light(picture, "srgb")))
        return value + 0.004 * random.standard_normal(value.shape)

    stack = ingest("c", captured(program, see))
    found = stack.attributes["white_balance"]
    if colour == "rgb":
        assert found is None
    else:
        np.testing.assert_allclose(found, gains, atol=0.01)
        assert stack.attributes["gains"] is None  # what is left does not flicker
