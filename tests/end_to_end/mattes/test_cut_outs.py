"""Glass without the monitor and the room around it, recovered from a capture without a mask, on a real server."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from services.cli.main import main
from services.client import ServiceError
from tests.end_to_end.conftest import Service
from tests.end_to_end.mattes.test_composites import decoded, post_composite
from workflows.images import float_formats, integer_formats
from workflows.programs.presets import preset
from workflows.simulation.glass_ball import glass_ball
from workflows.simulation.scene import write_capture

MONITOR = 512, 384


def test_the_object_is_cut_out(service: Service, tmp_path: Path) -> None:
    scene = glass_ball(96, 72, monitor=MONITOR, rays=16, distance=8)
    write_capture(scene, preset("sketch", *MONITOR), tmp_path / "ball.zip", noise=0.5, depth=16)
    capture = service.client.upload(tmp_path / "ball.zip")
    job = service.client.wait(service.client.recover(capture, quality="fast", cut_out=True)["id"])
    alpha = integer_formats.decode(
        service.http.get(f"/v1/mattes/{job['matte']}/layers/alpha.png").content, memory=1 << 24
    )
    shown, covered = alpha[:, :, 0] > 0, scene.coverage > 0.5
    assert not (shown & ~binary_dilation(covered, iterations=2)).any()
    assert not (binary_erosion(covered, iterations=2) & ~shown).any()
    transparent = integer_formats.decode(
        post_composite(service, job["matte"]).content, memory=1 << 24, alpha=True
    )
    np.testing.assert_array_equal(transparent[:, :, 3] > 0, shown)
    around = decoded(post_composite(service, job["matte"], around="backdrop"))
    assert (around[~binary_dilation(shown, iterations=3)].max(axis=1) > 0).mean() > 0.9  # no dark room
    alone, camera = (decoded(post_composite(service, job["matte"], fit=fit)) for fit in ("frame", "monitor"))
    within = binary_erosion(shown, iterations=2)
    np.testing.assert_array_equal(around[within], alone[within])
    assert not np.array_equal(camera[within], alone[within])
    np.testing.assert_array_equal(camera, decoded(post_composite(service, job["matte"])))
    for query in ({"fit": "frame", "enlarge": 2}, {"size": 50}, {}):
        assert_exr_is_multiplied_with_alpha(service, job["matte"], query)
    assert_files_take_a_plate(service, job["matte"], within)
    assert_command_writes_them(service, job["matte"], tmp_path / "glass")


def assert_exr_is_multiplied_with_alpha(service: Service, matte: str, query: dict[str, str | int]) -> None:
    backdrop = np.full((3, 4, 3), 0.5, np.float32)
    found = service.client.composite(matte, backdrop, **query)
    sent = float_formats.encode_exr("RGB", backdrop)
    png = integer_formats.decode(
        post_composite(service, matte, sent, transfer="linear", **query).content, memory=1 << 24, alpha=True
    )
    straight = integer_formats.to_unit(png)
    assert (((found[..., 3] > 0) & (found[..., 3] < 1)).any()) == bool(query)
    assert np.abs(np.clip(found[..., :3], 0, 1) - straight[..., :3] * straight[..., 3:]).max() < 1e-3


def assert_files_take_a_plate(service: Service, matte: str, within: NDArray[np.bool_]) -> None:
    assert service.client.matte(matte).answer["cut_out"]
    for name in ("blender.py", "nuke.nk", "nuke_stmap.nk"):
        assert service.client.layer(matte, name) != service.client.layer(matte, name, plate=True)
    monitor, plate = (
        float_formats.decode(service.client.layer(matte, "stmap.exr", plate=plate), memory=1 << 24)
        for plate in (False, True)
    )
    lit = within & (monitor[..., 2] > 0)
    # The frame sees the monitor smaller than itself, so what lies on it is nearer together there.
    assert (np.ptp(plate[lit, :2], axis=0) < 0.95 * np.ptp(monitor[lit, :2], axis=0)).all()
    with pytest.raises(ServiceError, match=r"S\.png takes no plate: only stmap\.exr, blender\.py"):
        service.client.layer(matte, "S.png", plate=True)


def assert_command_writes_them(service: Service, matte: str, folder: Path) -> None:
    def layers(tool: str) -> Result:
        command = ["layers", matte, str(folder), "--for", tool, "--plate", "--url", service.url]
        return CliRunner().invoke(main, command)

    assert layers("nuke").exit_code == 0
    for name, plate in (("lookups.exr", False), ("nuke.nk", True), ("nuke_stmap.nk", True)):
        assert (folder / name).read_bytes() == service.client.layer(matte, name, plate=plate)
    refused = layers("glsl")
    assert (refused.exit_code, "already" in refused.stderr) == (2, True)


def test_the_log_says_why_an_object_is_not_cut_out(service: Service, tmp_path: Path) -> None:
    scene = glass_ball(40, 30, monitor=MONITOR, rays=4, index=1.0, distance=8)  # which bends no light
    write_capture(scene, preset("sketch", *MONITOR), tmp_path / "none.zip", noise=0.5, depth=16)
    capture = service.client.upload(tmp_path / "none.zip")
    job = service.client.wait(service.client.recover(capture, quality="fast", cut_out=True)["id"])
    with pytest.raises(ServiceError, match="recover it with cut_out"):
        service.client.layer(job["matte"], "nuke.nk", plate=True)
    lines = [line["text"] for line in service.http.get(f"/v1/jobs/{job['id']}/log").json()["lines"]]
    assert any("the whole frame is recovered: nothing stands before the monitor" in line for line in lines)
