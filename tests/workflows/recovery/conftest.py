"""Small programs, and what a camera sees of them through a known T."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.recovery.photometry import Noise, Photometry
from workflows.recovery.sensing import Level, Sensing

Bands = list[tuple[int, int, int]]
SensingOf = Callable[..., Sensing]
Scene = tuple[NDArray[np.float32], Photometry, Noise]
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


def _observe(
    sensing: Sensing, truth: NDArray[np.float64], rho: float | list[float] = 0.7, seed: int = 1
) -> Scene:
    """Noisy measurements of true rows (n, 3, cells) on the finest grid."""
    rng = np.random.default_rng(seed)
    noise = Noise(4e-6, 5e-5)
    photometry = Photometry(
        np.full(truth.shape[:2], 0.02, np.float32),
        np.broadcast_to(np.asarray(rho, np.float32), truth.shape[:2]).copy(),
    )
    light = np.broadcast_to(sensing.levels[-1].light, (3, truth.shape[2], sensing.levels[-1].patterns.size))
    arrived = np.einsum("nci,cim->nmc", truth, light)
    clean = photometry.S[:, None] + photometry.rho[:, None] * arrived
    noisy = clean + np.sqrt(noise.variance(clean)) * rng.standard_normal(clean.shape)
    return noisy.astype(np.float32), photometry, noise


@pytest.fixture
def sensing_of() -> SensingOf:
    return _sensing_of


@pytest.fixture
def observe() -> Observe:
    return _observe
