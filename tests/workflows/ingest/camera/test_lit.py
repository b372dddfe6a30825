"""Which pixels see the monitor."""

from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from storage.layout.captures import thumbnail_edge
from workflows.images.tone_curves import from_light
from workflows.ingest.camera.lit import find_lit, windows
from workflows.programs.parts import Bernoulli, Constant, Monitor
from workflows.programs.program import Program

PROGRAM = Program(
    monitor=Monitor(width=64, height=48),
    parts=(
        Constant(kind="constant", levels=(0, 0.5, 1)),
        Constant(kind="constant", levels=(1, 0)),
        Bernoulli(kind="bernoulli", columns=4, rows=3, count=1, seed=7, colour="grey"),
    ),
)
LIGHT = np.array([0, 0.5, 1, 1, 0, 0.5])
HEIGHT, WIDTH = 90, 120


class Frames:
    """What `find_lit` needs of a stack."""

    height, width = HEIGHT, WIDTH

    def __init__(
        self, light: NDArray[np.floating], mask: NDArray[np.bool_] | None = None, **more: Any
    ) -> None:
        self.attributes: dict[str, Any] = {
            "patterns": list(range(len(light))),
            "exposures": [1.0] * len(light),
            "response": "srgb",
        } | more
        curve = self.attributes["response"]
        codes = from_light(light.astype(np.float32), curve if curve == "linear" else "srgb")
        self.codes = np.rint(np.clip(codes, 0, 1) * 65535).astype(np.uint16)
        self._mask = np.ones((HEIGHT, WIDTH), bool) if mask is None else mask

    def mask(self) -> NDArray[np.bool_]:
        return self._mask

    def thumbnails(self, frames: NDArray[np.intp]) -> NDArray[np.uint16] | None:
        edge = thumbnail_edge(HEIGHT, WIDTH)
        blocks = self.codes[frames].reshape(len(frames), HEIGHT // edge, edge, WIDTH // edge, edge)
        return blocks.mean(axis=(2, 4)).astype(np.uint16)


def seen_by(rho: NDArray[np.floating], light: NDArray[np.floating] = LIGHT) -> NDArray[np.floating]:
    return 0.01 + rho * light[:, np.newaxis, np.newaxis]


def lit(frames: Frames, program: Program = PROGRAM) -> NDArray[np.bool_]:
    return find_lit(cast(Any, frames), program)


@pytest.fixture
def rho() -> NDArray[np.float64]:
    """A monitor that fills a part of the frame, in a room that gives back a little of its light."""
    found = np.full((HEIGHT, WIDTH), 0.008)
    found[20:70, 30:100] = 0.8
    return found


@pytest.mark.parametrize("response", ["linear", "srgb", "unknown"])
def test_a_dark_room_does_not_see_the_monitor(rho: NDArray[np.float64], response: str) -> None:
    np.testing.assert_array_equal(lit(Frames(seen_by(rho), response=response)), rho > 0.1)


def test_dark_glass_sees_the_monitor(rho: NDArray[np.float64]) -> None:
    rho[30:50, 40:60] = 0.06
    np.testing.assert_array_equal(lit(Frames(seen_by(rho))), rho > 0.01)


def test_what_is_to_be_recovered_tells_how_bright_is_dark(rho: NDArray[np.float64]) -> None:
    glass = np.zeros(rho.shape, bool)
    glass[30:50, 40:60] = True
    rho[glass] = 0.02
    assert not lit(Frames(seen_by(rho)))[glass].any()
    assert lit(Frames(seen_by(rho), glass))[glass].all()


def test_what_changes_from_white_to_white_is_no_monitor(rho: NDArray[np.float64]) -> None:
    light = seen_by(rho)
    light[:, :10] = np.array([0.1, 0.1, 0.7, 0.1, 0.1, 0.1])[:, np.newaxis, np.newaxis]  # a border's cell
    np.testing.assert_array_equal(lit(Frames(light)), rho > 0.1)


def test_longer_exposures_are_not_compared(rho: NDArray[np.float64]) -> None:
    light = np.concatenate([seen_by(rho), 40 * seen_by(rho)])
    patterns = [*range(PROGRAM.count)] * 2
    times = [1.0] * PROGRAM.count + [40.0] * PROGRAM.count
    np.testing.assert_array_equal(lit(Frames(light, patterns=patterns, exposures=times)), rho > 0.1)


def test_where_nothing_is_brighter_before_white_all_pixels_count(rho: NDArray[np.float64]) -> None:
    assert lit(Frames(seen_by(0 * rho))).all()


def test_windows_cover_what_is_seen_from_end_to_end(rho: NDArray[np.float64]) -> None:
    found = windows(rho > 0.1, 12)
    assert len(found) == 16
    rows, columns = {(y.start, y.stop) for y, _ in found}, {(x.start, x.stop) for _, x in found}
    assert sorted(rows) == [(20, 32), (32, 44), (45, 57), (58, 70)]
    assert (min(columns)[0], max(columns)[1]) == (30, 100)
    assert windows(np.ones((3, 2), bool), 12) == [
        (slice(y, y + 1), slice(x, x + 1)) for y in range(3) for x in range(2)
    ]
