"""The schema of capture.json that the API serves and names in its errors."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from jsonschema import Draft202012Validator

from services.runtime.problems import CAPTURE_SCHEMA
from tests.parts.captures import nested_program, zip_bytes
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

ZIP = {"Content-Type": "application/zip"}


@pytest.fixture
def http(build: Callable[..., FastAPI]) -> TestClient:
    return TestClient(build(), "http://localhost")


@pytest.fixture
def archive(tmp_path: Path) -> zipfile.ZipFile:
    program = nested_program(bands=((8, 6, 16),), levels=2)
    write_capture(glass_ball.glass_ball(24, 16, rays=1), program, tmp_path / "ball.zip")
    return zipfile.ZipFile(tmp_path / "ball.zip")


def with_manifest(archive: zipfile.ZipFile, manifest: dict[str, Any]) -> bytes:
    """A capture archive with another capture.json."""
    files = {name: archive.read(name) for name in archive.namelist()}
    return zip_bytes(files | {"capture.json": json.dumps(manifest).encode()})


def test_schema_accepts_a_capture_and_refuses_a_broken_one(
    http: TestClient, archive: zipfile.ZipFile
) -> None:
    answer = http.get(CAPTURE_SCHEMA)
    assert answer.headers["content-type"] == "application/schema+json"
    validator = Draft202012Validator(answer.json())
    manifest = json.loads(archive.read("capture.json"))
    validator.validate(manifest)
    manifest["frames"][2]["exposure"] = 0
    (error,) = validator.iter_errors(manifest)
    assert list(error.absolute_path) == ["frames", 2, "exposure"]
    refusal = http.post("/v1/captures", content=with_manifest(archive, manifest), headers=ZIP).json()
    assert (refusal["type"], refusal["field"]) == ("urn:envmatte:problem:bad-capture", "frames.2.exposure")
    assert refusal["detail"].endswith(f"; see GET {CAPTURE_SCHEMA} for the schema of capture.json")


def test_errors_about_other_entries_do_not_name_the_schema(http: TestClient) -> None:
    refusal = http.post("/v1/captures", content=zip_bytes({}), headers=ZIP).json()
    assert "field" not in refusal
    assert CAPTURE_SCHEMA not in refusal["detail"]


def test_openapi_has_the_schema_with_all_its_parts(http: TestClient, archive: zipfile.ZipFile) -> None:
    document = http.get("/openapi.json").json()
    assert CAPTURE_SCHEMA in document["paths"]
    schema = {"$ref": "#/components/schemas/capture.json", "components": document["components"]}
    validator = Draft202012Validator(schema)
    manifest = json.loads(archive.read("capture.json"))
    validator.validate(manifest)
    manifest["program"]["parts"][0]["kind"] = "unknown"
    assert not validator.is_valid(manifest)
