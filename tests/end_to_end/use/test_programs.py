"""Programs over HTTP: stored by content, their files made on request."""

import io
import json
import zipfile
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem
from workflows.programs.border import Border
from workflows.programs.files import fit_to_screen, pictures, program_json
from workflows.programs.preset_names import PRESETS
from workflows.programs.program import Program
from workflows.programs.video import write_video

SKETCH = fit_to_screen("sketch", (320, 240), bordered=True)
CONSTANT = {"kind": "constant", "levels": [0, 1]}


def grid(columns: int, rows: int, count: int) -> dict:
    return {"kind": "bernoulli", "columns": columns, "rows": rows, "count": count, "seed": 1}


@pytest.fixture(scope="module")
def program(service: Service) -> dict:
    request = {"preset": "sketch", "monitor": {"width": 320, "height": 240}, "border": True}
    answer = service.http.post("/v1/programs", json=request)
    assert answer.status_code == 201, answer.text
    found: dict = answer.json()
    assert answer.headers["location"] == f"/v1/programs/{found['id']}"
    return found


def test_equal_programs_are_stored_once(service: Service, program: dict) -> None:
    assert Program.model_validate(program["program"]) == SKETCH
    assert program["patterns"] == 37
    assert program["monitor"] == {"width": 296, "height": 216}
    assert program["display"] == {"width": 320, "height": 240}
    again = service.http.post(
        "/v1/programs", json={"program": program_json(SKETCH)}, headers={"Idempotency-Key": "again"}
    )
    assert (again.status_code, again.json()) == (201, program)
    assert service.http.get(f"/v1/programs/{program['id']}").json() == program
    listed = service.http.get("/v1/programs").json()["programs"]
    assert [one["id"] for one in listed].count(program["id"]) == 1
    made = service.http.get(f"/v1/programs/{program['id']}/program.json").json()
    assert Program.model_validate(made) == SKETCH


def test_presets_are_listed(service: Service) -> None:
    listed = service.http.get("/v1/presets").json()["presets"]
    assert {one["name"]: one["description"] for one in listed} == PRESETS


def test_program_is_fitted_to_another_monitor(service: Service) -> None:
    request = {"program": program_json(SKETCH), "monitor": {"width": 640, "height": 480}}
    for border, size in ((False, (640, 480)), (True, (592, 432))):
        found = service.http.post("/v1/programs", json=request | {"border": border}).json()
        assert (found["monitor"]["width"], found["monitor"]["height"]) == size
    small = service.http.post(
        "/v1/programs", json={"preset": "sketch", "monitor": {"width": 30, "height": 20}}
    )
    assert small.json()["display"] is None
    check_problem(service.http.get(f"{small.headers['location']}/patterns.mp4"), 422, "bad-option")


def test_patterns_as_png_and_as_zip(service: Service, program: dict) -> None:
    url = f"/v1/programs/{program['id']}"
    zipped = service.http.get(f"{url}/patterns.zip")
    assert zipped.headers["content-type"] == "application/zip"
    every = list(pictures(SKETCH))
    with zipfile.ZipFile(io.BytesIO(zipped.content)) as archive:
        assert len(archive.namelist()) == 38
        assert Program.model_validate_json(archive.read("program.json")) == SKETCH
        for n in (0, 5, 31):
            answer = service.http.get(f"{url}/patterns/{n}.png")
            assert answer.headers["content-type"] == "image/png"
            assert answer.content == archive.read(f"{n:05d}.png")
            pixels = np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"))
            np.testing.assert_array_equal(pixels, np.broadcast_to(every[n], pixels.shape))
    for n in (-1, 37):
        problem = check_problem(service.http.get(f"{url}/patterns/{n}.png"), 404, "not-found")
        assert "0 to 36" in problem["detail"]


def test_video_equals_that_of_the_command_line(service: Service, program: dict, tmp_path: Path) -> None:
    answer = service.http.get(f"/v1/programs/{program['id']}/patterns.mp4?rate=10")
    assert answer.headers["content-type"] == "video/mp4"
    assert int(answer.headers["content-length"]) == len(answer.content)
    write_video(SKETCH, tmp_path / "film.mp4", 10, lambda done, of: None)
    assert answer.content == (tmp_path / "film.mp4").read_bytes()
    with av.open(io.BytesIO(answer.content)) as video:
        stream = video.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (320, 240, 10)
    check_problem(service.http.get(f"/v1/programs/{program['id']}/patterns.mp4?rate=99"), 422, "bad-request")


@pytest.mark.parametrize(
    ("body", "slug", "reason"),
    [
        ({}, "bad-request", "either a preset or a program"),
        (
            {"preset": "sketch", "program": program_json(SKETCH)},
            "bad-request",
            "either a preset or a program",
        ),
        ({"preset": "best"}, "bad-option", "default, quick"),
        ({"preset": "quick", "monitor": {"width": 5, "height": 5}}, "bad-option", "too small"),
        (
            {"preset": "quick", "monitor": {"width": 5, "height": 5}, "border": True},
            "bad-option",
            "no border",
        ),
        ({"preset": "quick", "monitor": {"width": 0, "height": 5}}, "bad-request", "monitor.width"),
        (
            {"preset": "quick", "monitor": {"width": 9000, "height": 9000}},
            "bad-option",
            "pixels of the monitor",
        ),
        (
            {"preset": "paper-400", "monitor": {"width": 4096, "height": 4096}},
            "bad-option",
            "patterns together",
        ),
        (
            {"program": {"monitor": {"width": 8, "height": 8}, "parts": [CONSTANT, grid(2, 2, 5000)]}},
            "bad-option",
            "5002 patterns",
        ),
        (
            {
                "program": {
                    "monitor": {"width": 8, "height": 8},
                    "parts": [CONSTANT, grid(2, 2, 5), grid(3, 3, 5)],
                }
            },
            "bad-option",
            "nest",
        ),
        ({"program": {"monitor": {"width": 8, "height": 8}, "parts": [CONSTANT]}}, "bad-request", "constant"),
        (
            {
                "program": {
                    "monitor": {"width": 8, "height": 8},
                    "parts": [CONSTANT, {"kind": "images", "files": ["/etc/passwd"]}],
                }
            },
            "bad-option",
            "images",
        ),
    ],
)
def test_program_that_cannot_be_shown_is_refused(
    service: Service, body: dict, slug: str, reason: str
) -> None:
    before = service.http.get("/v1/programs").json()
    problem = check_problem(service.http.post("/v1/programs", json=body), 422, slug)
    assert reason in problem["detail"]
    assert service.http.get("/v1/programs").json() == before


def test_invalid_program_body_is_refused(service: Service) -> None:
    many = json.dumps({"program": {"parts": [grid(2, 2, 2)] * 2000}}).encode()
    check_problem(service.http.post("/v1/programs", content=many), 413, "too-large")
    check_problem(service.http.post("/v1/programs", content=b"{"), 422, "bad-request")


def test_deleted_program_is_gone_with_its_files(service: Service) -> None:
    request = {"preset": "sketch", "monitor": {"width": 200, "height": 150}}
    url = service.http.post("/v1/programs", json=request).headers["location"]
    assert service.http.delete(url).status_code == 204
    for rest in ("", "/program.json", "/patterns.zip", "/patterns.mp4", "/patterns/0.png"):
        check_problem(service.http.get(url + rest), 404, "not-found")
    check_problem(service.http.delete(url), 404, "not-found")
    assert service.http.post("/v1/programs", json=request).headers["location"] == url


def test_the_display_has_the_monitor_inside(program: dict) -> None:
    assert Border.model_validate(program["display"]).inner[2:] == (296, 216)
