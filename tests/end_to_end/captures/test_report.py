"""A capture's report and contact sheet over HTTP."""

import io
from pathlib import Path

import pytest
from PIL import Image

from tests.end_to_end.conftest import HEIGHT, WIDTH, Service

pytestmark = pytest.mark.slow


def test_capture_links_to_its_report(service: Service, capture: str) -> None:
    link = service.http.get(f"/v1/captures/{capture}").json()["report"]
    report = service.http.get(link).json()
    assert report["level"] in ("good", "warning", "bad")
    names = [finding["name"] for finding in report["findings"]]
    assert {"frames", "exposure", "black", "noise", "unmeasured", "quality"} <= set(names)
    assert len(names) == len(set(names))
    for finding in report["findings"]:
        assert finding["message"]
        assert bool(finding["remedy"]) == (finding["level"] != "good")
    assert report["frames"]["kept"] == service.http.get(f"/v1/captures/{capture}").json()["frames"]
    assert report["camera"] == {"curve": "linear", "source": "given", "apart": None}
    assert report["quality"]["low"] < report["quality"]["high"]


def test_contact_sheet_is_a_small_picture(service: Service, capture: str) -> None:
    answer = service.http.get(f"/v1/captures/{capture}/contact-sheet.png")
    assert answer.headers["content-type"] == "image/png"
    with Image.open(io.BytesIO(answer.content)) as sheet:
        assert sheet.width > WIDTH * 4
        assert sheet.height > HEIGHT * 2


def test_no_report_before_the_ingest(service: Service, capture_archive: Path) -> None:
    cut = capture_archive.read_bytes().replace(b"\x89PNG", b"\x89GNP")
    made = service.http.post("/v1/captures", content=cut, headers={"Content-Type": "application/zip"}).json()
    assert made["report"] is None
    for what in ("report", "contact-sheet.png"):
        answer = service.http.get(f"/v1/captures/{made['id']}/{what}")
        assert answer.status_code == 409
        assert answer.json()["type"] == "urn:envmatte:problem:conflict"
        assert service.http.get(f"/v1/captures/none/{what}").status_code == 404
