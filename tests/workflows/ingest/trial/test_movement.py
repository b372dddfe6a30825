"""The path of a camera, from positions measured frame by frame."""

import numpy as np
import pytest
from numpy.typing import NDArray

from workflows.ingest.trial.movement import smooth_path

FRAMES, ERROR = 60, 0.03
TIME = np.arange(FRAMES)
PATHS = {
    "still": np.zeros(FRAMES),
    "creeps": np.linspace(-0.2, 0.2, FRAMES),
    "jolted": np.where(TIME > 35, 0.5, 0.0),
    "trembles": 0.2 * np.random.default_rng(4).standard_normal(FRAMES),
    "by hand": np.cumsum(0.5 * np.random.default_rng(5).standard_normal(FRAMES)),
}


def measured(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions along x and y, which moves the other way."""
    noise = ERROR * np.random.default_rng(6).standard_normal((FRAMES, 2))
    return np.stack([path, -path], axis=1) + noise


def smoothed(places: NDArray[np.float64]) -> NDArray[np.float64]:
    return smooth_path(places, np.full(places.shape, ERROR))


@pytest.mark.parametrize("name", PATHS)
def test_a_path_is_followed_as_well_as_it_was_measured(name: str) -> None:
    path = PATHS[name]
    places = measured(path)
    off, before = smoothed(places) - np.stack([path, -path], axis=1), places - np.stack([path, -path], axis=1)
    assert off.std() < 1.1 * before.std()
    assert np.abs(off).max() < 3.5 * ERROR


@pytest.mark.parametrize("name", ["still", "creeps", "jolted"])
@pytest.mark.parametrize("frame", [0, 5, 20, FRAMES - 1])
def test_a_frame_out_of_line_by_itself_does_not_count(name: str, frame: int) -> None:
    path = PATHS[name]
    places = measured(path)
    places[frame] += [0.8, -2.0]
    np.testing.assert_allclose(smoothed(places)[frame], [path[frame], -path[frame]], atol=3 * ERROR)


def test_frames_too_few_for_a_path_stay_where_they_are() -> None:
    places = np.array([[0.0, 1.0], [2.0, 0.0]])
    np.testing.assert_array_equal(smoothed(places), places)
