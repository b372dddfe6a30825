"""Small programs, and what a camera sees of them through a known T."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.recovery.camera.noise import NoiseModel
from workflows.recovery.camera.pattern_light import PatternLight
from workflows.recovery.camera.photometry import Photometry
from workflows.recovery.pyramid import Pyramid
from workflows.recovery.sensing import Level, Patterns, Sensing

Bands = list[tuple[int, int, int]]
SensingOf = Callable[..., Sensing]
PatternsOf = Callable[..., Patterns]
Gaussian = Callable[..., NDArray[np.float64]]
Scene = tuple[PatternLight, Photometry, NoiseModel]
Observe = Callable[..., Scene]


def _sensing_of(bands: Bands, seed: int, channels: int = 1) -> Sensing:
    """Levels of random bands (columns, rows, count), coarse to fine, each nested in the next."""
    rng = np.random.default_rng(seed)
    bits = [rng.integers(0, 2, (count, rows, columns, channels)) for columns, rows, count in bands]
    levels = []
    for i, (columns, rows, _) in enumerate(bands):
        fine = [
            b.repeat(rows // b.shape[1], 1).repeat(columns // b.shape[2], 2).reshape(len(b), -1, channels)
            for b in bits[: i + 1]
        ]
        light = np.ascontiguousarray(np.concatenate(fine).transpose(2, 1, 0), np.float32)
        levels.append(Level(columns, rows, np.arange(light.shape[2]), light))
    return Sensing(tuple(levels))


def _patterns_of(bands: Bands, seed: int, channels: int = 1) -> Patterns:
    """The patterns of a finest level, on the pyramid over it."""
    level = _sensing_of(bands, seed, channels).levels[-1]
    pyramid = Pyramid.over(level.columns, level.rows)
    light = level.light.reshape(channels, level.rows, level.columns, -1)
    code = np.concatenate([pyramid.light(of_channel) for of_channel in light], axis=1)
    return Patterns(pyramid, channels, np.rint(255 * code).astype(np.uint8))


def _gaussian(
    columns: int, rows: int, x: float, y: float, major: float, minor: float, angle: float = 0.0
) -> NDArray[np.float64]:
    """(1, 3, cells) the share of an oriented Gaussian on each cell of a grid, whose centre of cell 0 is at 0.5."""
    fine = 4
    v, u = (np.mgrid[: rows * fine, : columns * fine] + 0.5) / fine
    along = (u - x) * np.cos(angle) + (v - y) * np.sin(angle)
    across = (v - y) * np.cos(angle) - (u - x) * np.sin(angle)
    density = np.exp(-((along / major) ** 2 + (across / minor) ** 2) / 2)
    share = density.reshape(rows, fine, columns, fine).sum((1, 3)).reshape(1, 1, -1)
    return np.repeat(share / share.sum(), 3, axis=1)


def _observe(
    shown: Sensing | Patterns, truth: NDArray[np.float64], rho: float | list[float] = 0.7, seed: int = 1
) -> Scene:
    """Noisy light of true rows (n, 3, cells) on the finest grid."""
    rng = np.random.default_rng(seed)
    noise = NoiseModel(4e-6, 5e-5)
    S = np.full(truth.shape[:2], 0.02, np.float32)
    factor = np.broadcast_to(np.asarray(rho, np.float32), truth.shape[:2]).copy()
    photometry = Photometry(S, factor, noise.variance(S) / 4, noise.variance(S + factor) / 4)
    if isinstance(shown, Sensing):
        light = shown.levels[-1].light
    else:
        cells = shown.code[: truth.shape[2]].reshape(truth.shape[2], shown.channels, -1)
        light = cells.transpose(1, 0, 2) / 255
    light = np.broadcast_to(light, (3, *light.shape[1:]))
    arrived = np.einsum("nci,cim->nmc", truth, light)
    clean = photometry.S[:, None] + photometry.rho[:, None] * arrived
    noisy = clean + np.sqrt(noise.variance(clean)) * rng.standard_normal(clean.shape)
    return PatternLight.of(noisy.astype(np.float32)), photometry, noise


def _spoil(light: PatternLight, photometry: Photometry, far: float) -> tuple[PatternLight, Photometry]:
    """Twelve pixels, each with something else that is wrong; of pixels 1, 9 and 10 nothing is left."""
    measurements, S, rho = light.values.copy(), photometry.S.copy(), photometry.rho.copy()
    measurements[0, 3:40] = np.nan
    measurements[1] = np.nan
    measurements[2, 5] = np.inf
    measurements[3, 7] = far
    measurements[4] = 1  # saturated
    measurements[5, :, 1] = np.nan
    measurements[6] = 0
    measurements[7] = np.random.default_rng(0).random(measurements[7].shape)
    rho[8] = 1e-12
    S[9], rho[10] = np.nan, np.nan
    S[11] = 50
    return light._replace(values=measurements), photometry._replace(S=S, rho=rho)


@pytest.fixture
def spoil() -> Callable[..., tuple[PatternLight, Photometry]]:
    return _spoil


@pytest.fixture
def sensing_of() -> SensingOf:
    return _sensing_of


@pytest.fixture
def observe() -> Observe:
    return _observe


@pytest.fixture(scope="session")
def patterns_of() -> PatternsOf:
    return _patterns_of


@pytest.fixture(scope="session")
def gaussian() -> Gaussian:
    return _gaussian
