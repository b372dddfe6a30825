"""Cutting an object out of the bare monitor and the room around it, in captures without a mask."""

import io
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.ndimage import binary_dilation, binary_erosion

from storage.layout import mattes
from storage.layout.captures import Stack
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from storage.steps import FINISH, PREPARE
from workflows.composite import composite
from workflows.composite.backdrops.around import expose, over_frame, put_around
from workflows.composite.backdrops.backdrop import Backdrop
from workflows.composite.engine import Window
from workflows.jobs import Task, run
from workflows.mattes.steps import STEPS
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import Scene, write_capture
from workflows.untrusted.limits import Limits

Ingest = Callable[..., Stack]
MONITOR = 512, 384
LIMITS = Limits(1 << 30, 1 << 26)
ROUGH: dict[str, int | float] = {"most_lobes": 1, "steps": 1, "beam": 1, "doubt": 1.0, "passes": 1}
"""Options of a quick recovery, where it matters only which pixels are recovered."""


@pytest.fixture(scope="module")
def ball() -> Scene:
    return before_monitor(1.5)


def before_monitor(index: float) -> Scene:
    """A ball before a monitor that a dark room surrounds; with an index of 1 it bends no light."""
    return glass_ball(96, 72, monitor=MONITOR, rays=16, index=index, distance=8)


@pytest.fixture
def capture(ball: Scene, ingest: Ingest) -> Stack:
    """A capture of the ball, without a mask."""
    return ingest("c", archive(ball))


def archive(scene: Scene, *, mask: bool = False) -> bytes:
    file = io.BytesIO()
    write_capture(scene, preset("sketch", *MONITOR), file, noise=0.5, depth=16, mask=mask)
    return file.getvalue()


def recover(objects: Objects, name: str = "m", **options: bool | float | str) -> tuple[Matte, list[str]]:
    """A matte of the capture, and the notes for the job's log."""
    task = Task("j", "c", name, options, LIMITS)
    plan = run(STEPS, objects, task, PREPARE)[1]
    task = replace(task, plan=plan)
    for tile in reversed(range(plan["tiles"])):
        run(STEPS, objects, task, tile)
    assert not run(STEPS, objects, task, FINISH)[1].get("missing")
    return Matte(objects, name), plan["notes"]


@pytest.mark.parametrize(
    ("method", "off"),
    [
        ("lobes", 2),
        pytest.param("nn-dgsr", 5, marks=pytest.mark.slow),
    ],  # whose cells are as large as 3 pixels
)
def test_only_the_object_is_recovered(
    objects: Objects, capture: Stack, ball: Scene, method: str, off: int
) -> None:
    matte, notes = recover(objects, method=method, cut_out=True)
    assert not notes
    kept, covered = matte.layer("recovered"), ball.coverage > 0.5
    assert not (kept & ~binary_dilation(covered, iterations=off)).any()
    assert not (binary_erosion(covered, iterations=2) & ~kept).any()


@pytest.mark.slow
def test_what_is_kept_is_as_in_the_whole_frame(objects: Objects, capture: Stack) -> None:
    cut, _ = recover(objects, cut_out=True)
    whole, _ = recover(objects, "whole")
    kept = cut.layer("recovered")
    assert whole.layer("recovered").all()
    for name in ("S", "rho"):
        np.testing.assert_allclose(cut.layer(name)[kept], whole.layer(name)[kept], atol=2e-3)
    for name in ("S", "rho", "error", "count"):
        assert not cut.layer(name)[~kept].any()


def test_an_object_is_cut_out_the_same_whatever_the_tiles(
    objects: Objects, capture: Stack, digests: Callable[[str], dict[str, str]]
) -> None:
    recover(objects, cut_out=True, **ROUGH)
    recover(objects, "others", cut_out=True, tile=64, **ROUGH)
    assert digests(mattes.path("m")) == digests(mattes.path("others"))


@pytest.mark.slow
def test_around_the_object_the_backdrop_goes_on_as_through_bare_pixels(
    objects: Objects, capture: Stack
) -> None:
    cut, _ = recover(objects, cut_out=True)
    whole, _ = recover(objects, "whole")
    y, x = np.mgrid[:48, :64] / 8
    smooth = np.stack([0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.5 + 0.2 * np.sin(x + y)], axis=2)
    backdrop, window = Backdrop(smooth.astype(np.float32)), Window.of(cut)
    where = over_frame(cut, None)
    assert where is not None
    assert where.scale > 1.05  # the frame sees the room too
    taken, bare = (composite(matte, backdrop, placement=where) for matte in (cut, whole))
    made = put_around(cut, backdrop, where, expose(cut, taken), window)
    expected = expose(cut, bare)
    rho = whole.layer("rho").min(axis=2)
    around = ~binary_dilation(cut.layer("recovered"), iterations=2)
    lit = around & (rho > 0.9 * np.median(rho[around]))  # within the monitor
    assert lit.sum() > 1000
    assert np.sqrt(np.mean((made - expected)[lit] ** 2)) < 0.03  # without what bare pixels reflect
    assert (made[around] > 0.05).all()  # no room


def test_a_mask_is_taken_as_it_is(objects: Objects, ball: Scene, ingest: Ingest) -> None:
    stack = ingest("c", archive(ball, mask=True))
    matte, notes = recover(objects, cut_out=True, **ROUGH)
    assert not notes
    np.testing.assert_array_equal(matte.layer("recovered"), stack.mask())


@pytest.mark.slow
def test_without_an_object_the_whole_frame_is_recovered(objects: Objects, ingest: Ingest) -> None:
    ingest("c", archive(before_monitor(1.0)))
    matte, notes = recover(objects, cut_out=True, **ROUGH)
    assert notes == [
        "the object could not be cut out, so the whole frame is recovered: nothing stands before the monitor"
    ]
    assert matte.layer("recovered").all()


def test_where_no_bare_monitor_is_seen_the_whole_frame_is_recovered(
    objects: Objects, ball: Scene, ingest: Ingest
) -> None:
    there = sp.diags_array((ball.coverage.ravel() == 1).astype(np.float32), format="csr")
    red, green, blue = (there @ channel for channel in ball.transport)
    ingest("c", archive(replace(ball, transport=(red, green, blue))))
    matte, notes = recover(objects, cut_out=True, **ROUGH)
    assert [note.rpartition(": ")[2] for note in notes] == [
        "too little of the monitor is seen directly beside it"
    ]
    assert matte.layer("recovered").all()
