"""Stills with something before a part of the object, whose thumbnails still look like their patterns."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import shift

from storage.layout.captures import Stack
from tests.parts.captures import stills_archive
from workflows.ingest.report.report import report
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene

Codes = NDArray[np.uint8]
Ingest = Callable[..., Stack]
PROGRAM = preset("sketch", 320, 240, grey=True)
COVERED = [14, 22]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return glass_ball(96, 72, monitor=(320, 240), rays=9)


@pytest.fixture(scope="module")
def stills(scene: Scene) -> list[Codes]:
    return [frame.astype(np.uint8) for frame in scene.film(PROGRAM)]


def odd_frames(
    ingest: Ingest, scene: Scene, stills: list[Codes], others: Mapping[int, Codes]
) -> tuple[list[int], float]:
    """The frames that are left out, and the share of the light that T does not explain then."""
    shown = [others.get(n, still) for n, still in enumerate(stills)]
    stack = ingest("c", stills_archive(PROGRAM, shown, scene.object_mask))
    odd = stack.attributes["odd_frames"]
    findings = {finding.name: finding for finding in report(stack.attributes, stack.frames).findings}
    assert ("odd_frames" in findings) == bool(odd)
    return odd, stack.attributes["pattern_error"]


def hand_over(still: Codes, mask: NDArray[np.bool_], share: float, corner: int) -> Codes:
    """A still with something dark, and uneven, before a share of the object, from one of four corners."""
    y, x = np.indices(mask.shape)
    away = (x if corner % 2 else -x) + (y if corner // 2 else -y) + 3 * np.sin((x - y) / 4)
    hand = away < np.quantile(away[mask], share)
    skin = np.array([36, 27, 21]) * np.random.default_rng(corner).normal(1, 0.1, still.shape)
    return np.where(hand[..., np.newaxis], skin, still).astype(np.uint8)


def test_nothing_is_odd_in_good_stills_nor_where_the_camera_creeps_or_the_exposure_changes(
    ingest: Ingest, scene: Scene, stills: list[Codes]
) -> None:
    assert odd_frames(ingest, scene, stills, {})[0] == []
    exposures = 0.8 + 0.2 * np.random.default_rng(0).random(len(stills))
    changed = {
        n: np.clip(shift(exposures[n] * still, (n / 40, n / 60, 0), order=1, mode="nearest"), 0, 255).astype(
            np.uint8
        )
        for n, still in enumerate(stills)
    }
    assert odd_frames(ingest, scene, stills, changed)[0] == []


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_frames_with_a_hand_before_a_part_of_the_object_are_left_out(
    ingest: Ingest, scene: Scene, stills: list[Codes], share: float
) -> None:
    covered = {n: hand_over(stills[n], scene.object_mask, share, n % 4) for n in COVERED}
    odd, error = odd_frames(ingest, scene, stills, covered)
    assert odd == COVERED
    assert error < 0.02
