"""Bad input over HTTP gets a clear problem, leaves nothing behind, and the service keeps running."""

from pathlib import Path

import pytest

from tests.end_to_end.captures.broken_archives import (
    changed_archive,
    exposure_of_zero,
    frame_not_there,
    frame_of_an_unknown_camera,
    frame_of_another_size,
    frame_that_is_a_bomb,
    monitor_of_width_zero,
    no_manifest,
    one_level,
    other_format,
    path_outside_the_archive,
    pattern_out_of_range,
    pattern_without_frame,
    program_too_large,
    video_not_there,
)
from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until

pytestmark = pytest.mark.slow

ZIP = {"Content-Type": "application/zip"}


@pytest.mark.parametrize(
    ("change", "entry", "field"),
    [
        (no_manifest, "capture.json", None),
        (other_format, "capture.json", "format"),
        (frame_not_there, "frames/nowhere.png", "frames.3.file"),
        (pattern_without_frame, "capture.json", "frames"),
        (pattern_out_of_range, "frames/00007.png", "frames.7.pattern"),
        (one_level, "capture.json", "program"),
        (path_outside_the_archive, "../evil.png", None),
        (monitor_of_width_zero, "capture.json", "program.monitor.width"),
        (exposure_of_zero, "capture.json", "frames.2.exposure"),
        (program_too_large, "capture.json", "program"),
        (video_not_there, "clip.mp4", "video.file"),
    ],
)
def test_archive_is_refused_at_once(
    service: Service, capture_archive: Path, change, entry: str, field: str | None
) -> None:
    before = service.stored_ids()
    answer = service.http.post("/v1/captures", content=changed_archive(capture_archive, change), headers=ZIP)
    problem = check_problem(answer, 422, "bad-capture")
    assert problem["entry"] == entry
    assert problem.get("field") == field
    assert service.stored_ids() <= before


@pytest.mark.parametrize("change", [frame_of_another_size, frame_that_is_a_bomb, frame_of_an_unknown_camera])
def test_frame_refused_by_the_ingest(service: Service, capture_archive: Path, change) -> None:
    logged = len(service.log())
    answer = service.http.post("/v1/captures", content=changed_archive(capture_archive, change), headers=ZIP)
    assert answer.status_code == 201
    made = answer.json()
    waiting = service.client.recover(made["id"])
    until(lambda: service.client.capture(made["id"])["state"] != "ingesting")
    found = service.client.capture(made["id"])
    assert found["state"] == "failed"
    assert found["problem"]["type"] == "urn:envmatte:problem:bad-capture"
    entry = found["problem"]["entry"]
    assert entry in ("frames/00009.png", "frames/00009.nef")
    assert service.client.job(made["job"])["problem"] == found["problem"]
    until(lambda: service.client.job(waiting["id"])["state"] not in ("queued", "running"))
    job = service.client.job(waiting["id"])
    assert job["state"] == "failed"
    assert entry in job["problem"]["detail"]
    check_problem(service.http.post("/v1/jobs", json={"capture": made["id"]}), 409, "conflict")
    log = service.log()[logged:]
    assert "Traceback" not in log
    assert len([line for line in log.splitlines() if made["job"] in line and "failed" in line]) == 1, log
    # The failure is recorded before the data is deleted.
    until(lambda: not any(made["id"] in name for name in service.stored()))


def test_wrong_media_type_is_refused(service: Service, capture_archive: Path) -> None:
    answer = service.http.post(
        "/v1/captures", content=capture_archive.read_bytes(), headers={"Content-Type": "text/plain"}
    )
    check_problem(answer, 415, "wrong-media-type")


def test_unknown_option_is_refused(service: Service, capture: str) -> None:
    before = service.http.get("/v1/mattes").json()
    for options, field in (({"speed": 11}, "speed"), ({"method": "magic"}, "method"), ({"tile": 1}, "tile")):
        answer = service.http.post("/v1/jobs", json={"capture": capture, "options": options})
        assert check_problem(answer, 422, "bad-option")["field"] == field
    assert service.http.get("/v1/mattes").json() == before


@pytest.mark.parametrize("body", [b"", b"{", b'{"capture": 3}', b'{"capture": "x", "more": 1}', b"[1]"])
def test_invalid_job_is_refused(service: Service, body: bytes) -> None:
    answer = service.http.post("/v1/jobs", content=body, headers={"Content-Type": "application/json"})
    check_problem(answer, 422, "bad-request")


def test_too_large_bodies_are_refused(service: Service, matte: str) -> None:
    def endless(size: int):
        yield from (bytes(1 << 20) for _ in range(size >> 20))

    answer = service.http.post("/v1/jobs", content=endless(20 << 20))
    assert check_problem(answer, 413, "too-large")["limit"] == 64 << 10
    answer = service.http.post(f"/v1/mattes/{matte}/composite", content=endless(160 << 20))
    assert check_problem(answer, 413, "too-large")["limit"] == 128 << 20


def test_recovery_needs_nested_grids(service: Service, capture_archive: Path) -> None:
    def not_nested(manifest: dict, files: dict[str, bytes]) -> None:
        manifest["program"]["parts"][2] |= {"columns": 20, "rows": 15}

    made = service.http.post(
        "/v1/captures", content=changed_archive(capture_archive, not_nested), headers=ZIP
    ).json()
    service.client.wait(made["job"])
    problem = check_problem(service.http.post("/v1/jobs", json={"capture": made["id"]}), 422, "bad-option")
    assert "20 x 15" in problem["detail"]


@pytest.mark.parametrize("body", [b"", b"no image at all", b"\x89PNG\r\n\x1a\n" + b"\0" * 50])
def test_invalid_backdrop_is_refused(service: Service, matte: str, body: bytes) -> None:
    check_problem(service.http.post(f"/v1/mattes/{matte}/composite", content=body), 422, "bad-image")


def test_unsupported_accept_is_refused(service: Service, matte: str) -> None:
    answer = service.http.post(f"/v1/mattes/{matte}/composite", headers={"Accept": "image/gif"})
    check_problem(answer, 406, "not-acceptable")


def test_unknown_ids_are_not_found(service: Service) -> None:
    called = 0
    for path, calls in service.http.get("/openapi.json").json()["paths"].items():
        if "{id}" not in path or path.endswith("/play"):  # the same page for every id
            continue
        for method in calls:
            url = path.replace("{id}", "no-such-id").replace("{n}", "0")
            answer = service.http.request(method, f"{url}?x=0&y=0", headers={"Tus-Resumable": "1.0.0"})
            if method == "head":  # answers to HEAD have no body
                assert answer.status_code == 404
            else:
                check_problem(answer, 404, "not-found")
            called += 1
    assert called >= 11
    check_problem(service.http.post("/v1/jobs", json={"capture": "no-such-id"}), 404, "not-found")
    check_problem(service.http.get("/v1/captures?after=no-such-id"), 404, "not-found")
    check_problem(service.http.get("/v2/nothing"), 404, "not-found")
    for path, methods in {
        "/v1/jobs": "GET, HEAD, POST",
        "/v1/mattes/m": "DELETE, GET, HEAD, PATCH",
        "/": "GET, HEAD",
    }.items():
        refused = service.http.put(path)
        check_problem(refused, 405, "method-not-allowed")
        assert refused.headers["allow"] == methods
    check_problem(service.http.get("/v1/jobs?limit=many"), 422, "bad-request")


def test_calls_in_the_wrong_state_are_refused(service: Service, capture: str, matte: str) -> None:
    job = service.http.get(f"/v1/mattes/{matte}").json()["job"]
    check_problem(service.http.post(f"/v1/jobs/{job}/cancel"), 409, "conflict")
    check_problem(service.http.post(f"/v1/jobs/{job}/retry"), 409, "conflict")
    check_problem(service.http.get(f"/v1/captures/{capture}/frames/57.png"), 404, "not-found")


def test_service_survives_bad_input(service: Service, capture_archive: Path) -> None:
    assert service.client.wait(service.client.upload(capture_archive)["job"])["state"] == "succeeded"
    assert service.process.poll() is None
