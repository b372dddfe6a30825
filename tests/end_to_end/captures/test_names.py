"""How captures and mattes get their names."""

import json
import zipfile
from pathlib import Path

import pytest

from tests.end_to_end.conftest import Service


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


def test_matte_is_named_after_its_capture(service: Service, capture: str, matte: str) -> None:
    path = f"/v1/mattes/{matte}"
    assert service.http.get(path).json()["name"] == service.client.matte(matte).name == "ball"
    assert service.http.patch(path, json={"name": "tumbler"}).json()["name"] == "tumbler"
    found = service.http.get(f"/v1/captures/{capture}").json()
    assert found["name"] == "ball"
    names = {one["id"]: one["name"] for one in service.http.get("/v1/jobs").json()["jobs"]}
    recovery = service.client.matte(matte)["job"]
    assert names[recovery] == service.client.job(recovery).name == "tumbler"  # of what it makes
    assert names[found["job"]] == "ball"
    service.http.patch(path, json={"name": "ball"})


def test_imported_matte_is_named_after_its_file(service: Service, matte: str, tmp_path: Path) -> None:
    archive = tmp_path / "whisky glass.zip"
    service.client.export(matte, archive)
    assert service.client.import_matte(archive).name == "whisky glass"
    assert service.client.import_matte(archive, name="tumbler").name == "tumbler"
