"""The power of local tone mapping by the light of a film's border, beside light that patterns spread onto it."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from storage.layout.captures import Stack
from workflows.ingest.camera.border_exposure import BorderLight
from workflows.ingest.light.local_gain import DARK, Surroundings, surroundings
from workflows.ingest.trial.border_tone_mapping import border_power
from workflows.programs.border import border_light

FRAMES, VALUES = 120, 200


def bordered(
    power: float, spread: float = 0.0, noise: float = 0.004, seed: int = 3
) -> tuple[BorderLight, Surroundings]:
    """The border of a camera that maps tones, in a lens that spreads a share of the patterns' light onto it."""
    rng = np.random.default_rng(seed)
    thumbnails = gaussian_filter(rng.random((FRAMES, 60, 80)), (0, 6, 6))
    thumbnails = np.clip(0.5 + (thumbnails - thumbnails.mean()) * 0.25 / thumbnails.std(), 0, 1)
    stack = SimpleNamespace(
        attributes={"response": "srgb"},
        thumbnails=lambda: np.rint(65535 * thumbnails).astype(np.uint16),
        height=240,
        width=320,
    )
    near = surroundings(cast(Stack, stack), 1 / 10)
    assert near is not None
    places = np.stack([rng.integers(0, 240, VALUES), rng.integers(0, 2, VALUES) * 310])
    around = near.at(*places).astype(np.float64)
    bits = border_light(range(FRAMES))
    design = np.concatenate([np.ones((1, FRAMES)), bits]).T
    amounts = np.zeros((design.shape[1], VALUES))
    amounts[0] = 0.3
    amounts[1 + np.arange(VALUES) % len(bits), np.arange(VALUES)] = 0.25
    light = design @ amounts
    light = light * np.exp(-power * (around - around.mean())) + spread * (np.exp(around) - DARK) ** 2.2
    light += noise * rng.standard_normal(light.shape)
    usable = rng.random(light.shape) < 0.95
    own = design @ (np.linalg.pinv(design) @ light)
    rest = np.where(usable, light - own, 0)
    return BorderLight(np.ones(FRAMES), own, rest, usable, design, places), near


@pytest.mark.parametrize("spread", [0.0, 0.05])
@pytest.mark.parametrize("power", [0.1, 0.04])
def test_power_is_found_beside_light_that_patterns_spread(power: float, spread: float) -> None:
    found = border_power(*bordered(power, spread))
    assert found.power == pytest.approx(power, abs=max(5 * found.error, 0.1 * power))
    assert 0 < found.error < 0.005
    assert found.explained > 25


@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_camera_without_tone_mapping_has_no_power(spread: float) -> None:
    found = border_power(*bordered(0.0, spread))
    assert abs(found.power) < 0.005


def test_standard_error_is_the_spread_of_repeated_films() -> None:
    found = [border_power(*bordered(0.1, noise=0.03, seed=seed)) for seed in range(10)]
    spread = np.std([one.power for one in found])
    assert np.mean([one.error for one in found]) == pytest.approx(spread, rel=0.5)


def test_surroundings_that_never_change_tell_nothing() -> None:
    border, near = bordered(0.1)
    found = border_power(border, near._replace(values=np.zeros_like(near.values)))
    assert found.error == np.inf
