"""Previews of mattes: there after the first step, gone after the last, and near to the matte."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from storage.errors import Corrupt
from storage.layout import mattes
from storage.layout.captures import Stack
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from tests.parts.captures import nested_program
from workflows.composite import composite
from workflows.ingest.light.measured_light import read_light
from workflows.jobs import Task, run
from workflows.mattes import preview
from workflows.mattes.steps import STEPS
from workflows.programs.program import Program
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture
from workflows.untrusted.limits import Limits

Ingest = Callable[..., Stack]
WIDTH, HEIGHT, SPACING = 52, 39, 4


@pytest.fixture
def stack(ingest: Ingest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stack:
    """A capture of a ball with a mask, whose matte has a preview."""
    scene = glass_ball(WIDTH, HEIGHT, monitor=(64, 48), rays=4)
    program = nested_program((64, 48), bands=((4, 3, 14), (8, 6, 10)), levels=5)
    target = io.BytesIO()
    write_capture(scene, program, target, mask=True, noise=0.5)
    monkeypatch.setattr(preview, "PIXELS", int(scene.object_mask.sum()) // SPACING**2 + 1)
    return ingest("c", target.getvalue())


@pytest.mark.parametrize("method", ["lobes", "nn-dgsr"])
def test_preview_is_there_until_the_matte_is_complete(
    objects: Objects, folder: Path, stack: Stack, method: str
) -> None:
    task = Task("j", "c", "m", {"method": method}, Limits(1 << 30, 1 << 26))
    plan = run(STEPS, objects, task, PREPARE)[1]
    assert plan["figures"]["preview"] == SPACING
    small = mattes.Matte(objects, mattes.preview_of("m"))
    assert not small.missing()
    at = np.s_[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING]
    np.testing.assert_array_equal(small.layer("recovered"), stack.mask()[at])
    backdrop = np.random.default_rng(0).random((6, 8, 3), np.float32).repeat(8, axis=0).repeat(8, axis=1)
    coarse = composite(small, backdrop)
    for tile in range(plan["tiles"]):
        run(STEPS, objects, task, tile)
    whole = composite(mattes.Matte(objects, "m"), backdrop)
    np.testing.assert_array_equal(coarse[..., 3], whole[at][..., 3])
    assert np.sqrt(np.mean((coarse - whole[at])[coarse[..., 3] > 0] ** 2)) < 0.05
    unfinished = folder / mattes.path("m") / "S/c/0/0/0#1"  # of a worker that was killed
    unfinished.write_bytes(b"half a chunk")
    assert not run(STEPS, objects, task, FINISH)[1].get("missing")
    assert not unfinished.exists()
    with pytest.raises(Corrupt):
        mattes.Matte(objects, mattes.preview_of("m"))
    assert not [path for path in objects.paths_below(mattes.path("m")) if "preview" in path]


def test_matte_does_not_depend_on_its_preview(
    objects: Objects, stack: Stack, digests: Callable[[str], dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def recovered() -> dict[str, str]:
        task = Task("j", "c", "m", {}, Limits(1 << 30, 1 << 26))
        objects.delete(mattes.path("m"))
        for tile in [*range(run(STEPS, objects, task, PREPARE)[1]["tiles"]), FINISH]:
            run(STEPS, objects, task, tile)
        return digests("mattes/m")

    first = recovered()
    monkeypatch.setattr(preview, "PIXELS", 1 << 14)
    assert preview.spacing_of(stack) is None
    assert recovered() == first


def test_frames_that_drift_are_shifted_by_whole_pixels(stack: Stack) -> None:
    places = [0.0, 0.0], [3.0, -2.0], [-1.0, 1.0]
    stack.annotate(shifts=[places[frame % 3] for frame in range(stack.frames)])
    program = Program.model_validate(stack.attributes["program"])
    whole, _ = read_light(stack, (slice(None), slice(None)), program, None)
    at = np.s_[1::SPACING, 2::SPACING]
    some, recovered = read_light(stack, at, program, None)
    chosen = np.zeros((HEIGHT, WIDTH), bool)
    chosen[at] = True
    for expected, found in zip(whole, some, strict=True):
        np.testing.assert_allclose(found, expected[chosen[stack.mask()]], atol=1e-6)
    # Less than half a pixel is left as it is.
    stack.annotate(shifts=[[0.4, -0.4]] * stack.frames)
    moved, _ = read_light(stack, at, program, None)
    stack.annotate(shifts=None)
    at_rest, _ = read_light(stack, at, program, None)
    np.testing.assert_array_equal(moved.values, at_rest.values)
    assert recovered.shape == chosen[at].shape
