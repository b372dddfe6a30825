"""Renaming captures and mattes, and finding them by their names."""

from collections.abc import Callable

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine

from storage.database.engine import writing
from storage.records import captures, mattes


@pytest.fixture
def http(engine: Engine, build: Callable[..., FastAPI]) -> TestClient:
    """An API with a capture and a matte, both of the id "ball"."""
    with writing(engine) as c:
        captures.add(c, "ball", "j", name="ball", bytes=1, frames=1, program={})
        mattes.add_imported(c, "ball", {}, {}, name="ball")
    return TestClient(build(), "http://localhost")


@pytest.mark.parametrize("collection", ["captures", "mattes"])
def test_what_is_renamed_is_found_by_its_new_name(http: TestClient, collection: str) -> None:
    def found(name: str) -> list[str]:
        answer = http.get(f"/v1/{collection}", params={"name": name})
        return [one["name"] for one in answer.json()[collection]]

    assert (found("BALL"), found("tumbler")) == (["ball"], [])
    path = f"/v1/{collection}/ball"
    answer = http.patch(path, json={"name": "  tumbler "})
    assert (answer.status_code, answer.json()["name"]) == (200, "tumbler")
    assert http.get(path).json()["name"] == "tumbler"
    assert (found("ball"), found("umb")) == ([], ["tumbler"])


@pytest.mark.parametrize("collection", ["captures", "mattes"])
def test_invalid_changes_are_refused(http: TestClient, collection: str) -> None:
    path = f"/v1/{collection}/ball"
    for wrong in ({"name": ""}, {"name": " "}, {"name": "x" * 201}, {"state": "ready"}, {}):
        assert http.patch(path, json=wrong).status_code == 422
    for name, why in {
        "": "must have 1 or more characters",
        " ": "must have 1 or more characters",
        "a\0b": "must have no line breaks or other control characters",
        "a\x1b[2Jb": "must have no line breaks or other control characters",
    }.items():
        assert http.patch(path, json={"name": name}).json()["detail"] == f"name: {why}"
        if name.strip():
            found = http.get(f"/v1/{collection}", params={"name": name})
            assert (found.status_code, found.json()["detail"]) == (422, f"name: {why}")
            created = http.post(
                f"/v1/{collection}", params={"name": name}, headers={"Content-Type": "application/zip"}
            )
            assert (created.status_code, created.json()["detail"]) == (422, f"name: {why}")
    assert http.get(path).json()["name"] == "ball"
    assert http.patch(f"/v1/{collection}/none", json={"name": "x"}).status_code == 404
    assert http.patch(path, content=b" " * 5000).status_code == 413
