"""How captures get their names, and new ones."""

import json
import zipfile
from pathlib import Path

import pytest

from tests.end_to_end.conftest import Service
from tests.end_to_end.problems import check_problem


@pytest.fixture(scope="module")
def nameless(capture_archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture that has no name in its capture.json."""
    path = tmp_path_factory.mktemp("nameless") / "whisky glass.zip"
    with zipfile.ZipFile(capture_archive) as source, zipfile.ZipFile(path, "w") as target:
        for entry in source.namelist():
            content = source.read(entry)
            if entry == "capture.json":
                content = json.dumps(json.loads(content) | {"name": ""}).encode()
            target.writestr(entry, content)
    return path


def test_capture_without_a_name_is_named_after_its_file(
    service: Service, nameless: Path, capture: str
) -> None:
    assert service.client.upload(nameless)["name"] == "whisky glass"
    assert service.http.get(f"/v1/captures/{capture}").json()["name"] == "ball"  # that of its capture.json


def test_capture_is_renamed(service: Service, capture: str) -> None:
    path = f"/v1/captures/{capture}"
    answer = service.http.patch(path, json={"name": "  tumbler "})
    assert (answer.status_code, answer.json()["name"]) == (200, "tumbler")
    listed = service.http.get("/v1/captures?limit=1000").json()["captures"]
    assert [one["name"] for one in listed if one["id"] == capture] == ["tumbler"]
    for wrong in ({"name": ""}, {"name": " "}, {"name": "x" * 201}, {"state": "ready"}, {}):
        check_problem(service.http.patch(path, json=wrong), 422, "bad-request")
    check_problem(service.http.patch("/v1/captures/none", json={"name": "x"}), 404, "not-found")
    service.http.patch(path, json={"name": "ball"})
