"""From a capture to a composite over HTTP."""

import io
import json
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.end_to_end.captures.tus import wait_until_deleted
from tests.end_to_end.conftest import HEIGHT, WIDTH, Service, digests, png
from tests.parts.waiting import until
from workflows.images import integer_formats
from workflows.images.tone_curves import to_light
from workflows.programs.parts import Images
from workflows.programs.program import Program
from workflows.simulation.scene import Scene, write_capture


def test_an_upload_is_ingested(service: Service, capture_archive: Path) -> None:
    headers = {"Content-Type": "application/zip"}
    answer = service.http.post(
        "/v1/captures?name=mine", content=capture_archive.read_bytes(), headers=headers
    )
    assert answer.status_code == 201
    made = answer.json()
    assert answer.headers["location"] == f"/v1/captures/{made['id']}"
    assert (made["name"], made["bytes"]) == ("mine", capture_archive.stat().st_size)
    job = service.client.wait(made["job"])
    assert (job["kind"], job["state"], job["progress"], job["problem"]) == ("ingest", "succeeded", 1, None)
    found = service.client.capture(made["id"])
    assert (found["state"], found["width"], found["height"], found["frames"]) == ("ready", WIDTH, HEIGHT, 57)
    assert datetime.fromisoformat(found["created_at"]).utcoffset() is not None
    wait_until_deleted(service, made["id"])


def test_frames_are_stored_unchanged(service: Service, capture: str, scene: Scene, program) -> None:
    filmed = list(scene.film(program))
    for n in (0, 30, 56):
        answer = service.http.get(f"/v1/captures/{capture}/frames/{n}.png")
        assert answer.headers["content-type"] == "image/png"
        np.testing.assert_array_equal(integer_formats.decode(answer.content, memory=1 << 24), filmed[n])


def test_head_is_get_without_the_body(service: Service, matte: str) -> None:
    paths = ("/", "/healthz", "/v1/captures", f"/v1/mattes/{matte}/layers/S.png", "/v1/jobs/no-such-id")
    for path in paths:  # on one connection: a body would be taken for the next answer
        whole, head = service.http.get(path), service.http.head(path)
        assert (head.status_code, head.content) == (whole.status_code, b"")
        assert whole.content
        for name in ("content-type", "content-length", "etag"):
            assert head.headers.get(name) == whole.headers.get(name), (path, name)


def test_a_recovery_goes_from_queued_to_succeeded(service: Service, capture: str) -> None:
    answer = service.http.post(
        "/v1/jobs", json={"capture": capture, "options": {"method": "lobes", "tile": 32}}
    )
    assert answer.status_code == 202
    posted = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{posted['id']}"
    seen: list[dict] = []
    ended = service.client.wait(posted["id"], progress=seen.append, poll=0.02)
    progress = [job["progress"] for job in seen]
    assert progress == sorted(progress)
    assert progress[-1] == 1
    assert ended["tiles"] == {"total": 4, "done": 4, "failed": 0}
    assert ended["pixels"] == WIDTH * HEIGHT
    assert ended["run_seconds"] > 0
    log = [line["text"] for line in service.http.get(f"/v1/jobs/{posted['id']}/log").json()["lines"]]
    assert log == ["queued", "preparing", "recovering", "finishing", "succeeded"]


@pytest.mark.parametrize("transfer", ["srgb", "linear"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_composite_is_close_to_the_truth(
    service: Service, matte: str, scene: Scene, transfer: str, dtype: type
) -> None:
    # Soft enough for the 32 x 24 cells of the program; finer detail is measured elsewhere.
    y, x = np.mgrid[:96, :128] / 128
    backdrop = np.stack([x, 1 - x, 0.5 + 0.4 * np.sin(9 * y)], axis=-1).astype(np.float32)
    answer = service.client.composite(matte, png(backdrop, transfer, dtype), transfer=transfer)
    pixels = integer_formats.decode(answer, memory=1 << 24)
    assert (pixels.shape, pixels.dtype) == ((HEIGHT, WIDTH, 3), dtype)
    error = to_light(integer_formats.to_unit(pixels), transfer) - np.clip(scene.truth(backdrop), 0, 1)
    assert -10 * np.log10(np.mean(error[scene.object_mask] ** 2)) > 32


def test_composite_reports_how_long_each_step_took(service: Service, matte: str) -> None:
    answer = service.http.post(
        f"/v1/mattes/{matte}/composite", content=png(np.ones((4, 4, 3), "f4"), "srgb", np.uint8)
    )
    assert answer.headers["content-type"] == "image/png"
    names = [part.split(";")[0] for part in answer.headers["server-timing"].split(", ")]
    assert names == ["decode", "open", "light", "composite", "codes", "encode"]


@pytest.mark.slow
def test_masked_pixels_are_transparent(service: Service, scene: Scene, program, tmp_path: Path) -> None:
    masked = tmp_path / "masked.zip"
    write_capture(scene, program, masked, mask=True)
    uploaded = service.client.upload(masked)
    job = service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])
    assert job["pixels"] == scene.object_mask.sum()
    answer = service.client.composite(job["matte"], png(np.ones((4, 4, 3), "f4"), "srgb", np.uint8))
    with Image.open(io.BytesIO(answer)) as picture:
        alpha = np.asarray(picture)[..., 3]
    np.testing.assert_array_equal(alpha > 0, scene.object_mask)
    confidence = integer_formats.decode(service.client.layer(job["matte"], "confidence.png"), memory=1 << 24)[
        ..., 0
    ]
    assert confidence.dtype == np.uint16
    np.testing.assert_array_equal(confidence > 0, scene.object_mask)
    assert np.unique(confidence).size > 100


def test_lists_are_newest_first_and_paged(service: Service, capture: str, capture_archive: Path) -> None:
    made = [service.client.upload(capture_archive)["id"] for _ in range(3)]
    ids = [item["id"] for item in service.http.get("/v1/captures?limit=3").json()["captures"]]
    assert ids == made[::-1]
    rest = service.http.get("/v1/captures", params={"limit": 1, "after": ids[0]}).json()["captures"]
    assert [item["id"] for item in rest] == [made[1]]
    for capture in made:
        service.client.cancel(service.client.capture(capture)["job"])
    states = {job["state"] for job in service.http.get("/v1/jobs?state=succeeded").json()["jobs"]}
    assert states == {"succeeded"}


def test_repeated_post_with_one_key_creates_once(
    service: Service, capture_archive: Path, capture: str
) -> None:
    headers = {"Content-Type": "application/zip", "Idempotency-Key": "upload-1"}
    first, second = (
        service.http.post("/v1/captures", content=capture_archive.read_bytes(), headers=headers).json()["id"]
        for _ in "ab"
    )
    assert first == second
    key = {"Idempotency-Key": "job-1"}
    jobs = {service.http.post("/v1/jobs", json={"capture": capture}, headers=key).json()["id"] for _ in "ab"}
    assert len(jobs) == 1
    service.client.cancel(jobs.pop())


@pytest.mark.slow
def test_deleting_leaves_nothing(service: Service, capture_archive: Path) -> None:
    uploaded = service.client.upload(capture_archive)
    job = service.client.wait(service.client.recover(uploaded["id"], quality="fast")["id"])
    assert any(job["matte"] in name for name in service.stored())
    assert service.http.delete(f"/v1/mattes/{job['matte']}").status_code == 204
    assert service.http.delete(f"/v1/captures/{uploaded['id']}").status_code == 204
    assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert not [name for name in service.stored() if job["matte"] in name or uploaded["id"] in name]
    for path in (f"mattes/{job['matte']}", f"captures/{uploaded['id']}", f"jobs/{job['id']}"):
        assert service.http.get(f"/v1/{path}").status_code == 404


def test_running_service_is_alive_and_ready(service: Service) -> None:
    assert service.http.get("/healthz").json() == {"status": "alive"}
    until(lambda: service.http.get("/readyz").status_code == 200)  # the first check may take a while
    assert service.http.get("/readyz").json() == {
        "ready": True,
        "database": "ok",
        "store": "ok",
        "cluster": "ok",
    }


def test_options_are_described(service: Service) -> None:
    options = {option["name"]: option for option in service.http.get("/v1/options").json()["options"]}
    assert options["method"]["values"] == ["lobes", "nn-dgsr"]
    assert options["method"]["default"] == "lobes"
    assert (options["tile"]["minimum"], options["tile"]["maximum"]) == (16, 1024)
    assert all(option["description"] for option in options.values())


@pytest.mark.slow
def test_program_of_images_gives_the_same_matte(
    service: Service, matte: str, scene: Scene, program: Program, tmp_path: Path
) -> None:
    constant, *bands = program.parts
    shown = [pattern.astype(np.float32) for band in bands for pattern in band.bits]
    files = tuple(f"patterns/{n}.png" for n in range(len(shown)))
    same = Program(monitor=program.monitor, parts=(constant, Images(kind="images", files=files)))
    capture_archive = tmp_path / "images.zip"
    write_capture(scene, same, capture_archive, images=shown)
    uploaded = service.client.upload(capture_archive)
    job = service.client.wait(service.client.recover(uploaded["id"])["id"])
    folders = [service.data / "store" / "mattes" / name for name in (job["matte"], matte)]
    found, expected = map(digests, folders)
    # Images do not say that they are random patterns on fixed grids, which have no interval.
    attributes = [json.loads((folder / "zarr.json").read_text())["attributes"] for folder in folders]
    assert {name for name, value in attributes[0].items() if value != attributes[1].get(name)} == {
        "interval",
        "crc32c",
    }
    assert found.pop("zarr.json") != expected.pop("zarr.json")
    assert found == expected
