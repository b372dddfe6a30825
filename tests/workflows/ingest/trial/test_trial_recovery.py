"""A sample of a capture: what it has of the pixels around its own, and its recovery in parts, on several threads."""

import io
from collections.abc import Callable

import numpy as np
import pytest

from storage.layout.captures import Stack
from tests.parts.captures import nested_program
from workflows.ingest.pixel_sample import BLOCK, EDGE, MARGIN, PixelSample, take_sample
from workflows.ingest.trial import trial_recovery
from workflows.ingest.trial.trial_recovery import ALONE, Calibrated, recover_sample
from workflows.programs.pyramid_light import lay_out
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture


def test_a_sample_is_the_same_in_any_parts_and_on_any_threads(
    ingest: Callable[..., Stack], monkeypatch: pytest.MonkeyPatch
) -> None:
    program, target = nested_program((160, 120), bands=((8, 6, 12), (16, 12, 12), (32, 24, 12))), io.BytesIO()
    write_capture(glass_ball(80, 60, monitor=(160, 120), rays=4), program, target, noise=0.5)
    stack = ingest("c", target.getvalue())
    sample = take_sample(stack)
    assert sample
    n = len(sample.chosen[0])
    assert n > 2 * ALONE
    patterns, at_rest = lay_out(program, "srgb"), np.zeros((stack.frames, 3))

    def recovered(alone: int, cores: int) -> list[bytes]:
        monkeypatch.setattr(trial_recovery, "ALONE", alone)
        monkeypatch.setattr(trial_recovery, "CORES", cores)
        found = recover_sample(Calibrated(stack, program, "srgb"), patterns, sample, at_rest)
        assert found
        assert len(found.photometry.S) == len(found.transport.count) == n
        fields = (*vars(found.transport).values(), *found.photometry)
        return [np.asarray(value).tobytes() for value in fields]

    whole = recovered(n, 1)
    assert recovered(ALONE, 1) == whole
    assert recovered(ALONE, 3) == whole


def test_rings_are_the_means_of_the_pixels_around_each() -> None:
    size = EDGE + 2 * MARGIN
    codes = np.random.default_rng(3).integers(0, 256, (2, 3, size, size, 3), np.uint8)
    chosen = tuple(np.array(axis, np.intp) for axis in ([0, 2], [0, 7], [5, 7]))
    first, second = PixelSample(codes, chosen, chosen, 2, np.zeros((3, 2), np.intp)).rings(2)
    assert first.shape == second.shape == (2, 2)
    for n, (square, y, x) in enumerate(zip(*chosen, strict=True)):
        down, across = y + MARGIN, x + MARGIN
        near, wide = (
            codes[1, square, down - k : down + k + 1, across - k : across + k + 1].mean(axis=2) / 255
            for k in (1, 2)
        )
        assert first[1, n] == pytest.approx((near.sum() - near[1, 1]) / 8)
        assert second[1, n] == pytest.approx((wide.sum() - near.sum()) / 16)


def test_blocks_are_neighbours_from_all_squares() -> None:
    corners = np.zeros((3, 2), np.intp)
    inside = np.ones((3, EDGE, EDGE), bool)
    inside[1, :, :-BLOCK] = False  # the square's left half sees nothing
    every = np.nonzero(inside)

    def blocks(most: int) -> list[list[tuple[int, int]]]:
        chosen = tuple(axis[:most] for axis in every)
        square, y, x = PixelSample(np.empty(0, np.uint8), chosen, every, 0, corners).blocks().chosen
        return [list(zip(y[square == n].tolist(), x[square == n].tolist(), strict=True)) for n in range(3)]

    found = blocks(3 * BLOCK**2)
    assert [len(pixels) for pixels in found] == [BLOCK**2] * 3
    for pixels in found:
        y, x = np.array(pixels).T
        assert np.ptp(y) == np.ptp(x) == BLOCK - 1
    assert min(x for _, x in found[1]) == EDGE - BLOCK
    assert [len(pixels) for pixels in blocks(BLOCK**2)] == [BLOCK**2, 0, 0]  # no more than memory allows
    assert sum(map(len, blocks(len(every[0])))) == len(every[0])
