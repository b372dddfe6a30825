"""From a video to a composite over HTTP."""

import io
import json
import zipfile

import numpy as np
import pytest

from tests.end_to_end.conftest import HEIGHT, WIDTH, Service, png
from tests.parts.waiting import until
from tests.workflows.ingest.video.camera import Camera, capture, film, lights
from workflows.images import integer_formats
from workflows.images.tone_curves import to_light
from workflows.programs.program import Program
from workflows.simulation.scene import Scene

CAMERA = Camera(hold=0.25, hand=(6.0, 6.8), options={"crf": "12"})


@pytest.fixture(scope="module")
def uploaded(service: Service, scene: Scene, program: Program) -> dict:
    """An ingested recording of the scene, with a hand in front of it for a while."""
    made = film(lights(scene, program), CAMERA)
    manifest, files = capture(program, made.data, 1 / CAMERA.hold)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("capture.json", json.dumps(manifest | {"mask": "mask.png"}))
        archive.writestr("clip.mp4", files["clip.mp4"])
        archive.writestr(
            "mask.png", integer_formats.encode_png(scene.object_mask.astype(np.uint8)[..., None] * 255)
        )
    answer = service.http.post(
        "/v1/captures", content=target.getvalue(), headers={"Content-Type": "application/zip"}
    )
    assert answer.status_code == 201, answer.text
    service.client.wait(answer.json()["job"])
    return service.client.capture(answer.json()["id"])


def test_ingest_reports_what_it_found(service: Service, uploaded: dict, program: Program) -> None:
    assert (uploaded["state"], uploaded["width"], uploaded["height"]) == ("ready", WIDTH, HEIGHT)
    assert program.count - 6 <= uploaded["frames"] < program.count
    lines = [line["text"] for line in service.http.get(f"/v1/jobs/{uploaded['job']}/log").json()["lines"]]
    assert any(f"{uploaded['frames']} of {program.count} patterns found" in line for line in lines), lines
    assert any(line.startswith("no frame of pattern") for line in lines), lines
    frame = service.http.get(f"/v1/captures/{uploaded['id']}/frames/0.png")
    assert integer_formats.decode(frame.content, memory=1 << 24).shape == (HEIGHT, WIDTH, 3)


def test_a_composite_is_close_to_the_truth(service: Service, uploaded: dict, scene: Scene) -> None:
    matte = service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])["matte"]
    y, x = np.mgrid[:96, :128] / 128
    backdrop = np.stack([x, 1 - x, 0.5 + 0.4 * np.sin(9 * y)], axis=-1).astype(np.float32)
    answer = service.client.composite(matte, png(backdrop, "linear", np.uint16), transfer="linear")
    pixels = integer_formats.to_unit(integer_formats.decode(answer, memory=1 << 24))[..., :3]
    error = to_light(pixels, "linear") - np.clip(scene.truth(backdrop), 0, 1)
    assert -10 * np.log10(np.mean(error[scene.object_mask] ** 2)) > 32


def test_recording_of_another_program_is_refused(service: Service, scene: Scene, program: Program) -> None:
    manifest, files = capture(program, film(lights(scene, program)[:12], CAMERA).data, 1 / CAMERA.hold)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("capture.json", json.dumps(manifest))
        archive.writestr("clip.mp4", files["clip.mp4"])
    before = service.stored()
    made = service.http.post(
        "/v1/captures", content=target.getvalue(), headers={"Content-Type": "application/zip"}
    ).json()
    until(lambda: service.client.job(made["job"]).ended)
    job = service.client.job(made["job"])
    assert (job["state"], job["problem"]["entry"]) == ("failed", "clip.mp4")
    # the failure is recorded before the data is deleted
    until(lambda: not any(made["id"] in name for name in service.stored() - before))
