"""Webhooks given in a body, or in the query beside one that is not JSON: the app with a real database and store."""

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine

from storage.database.engine import reading, writing
from storage.records import jobs, mattes
from tests.parts.captures import nested_program
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

URL = "http://127.0.0.1:9/webhook?by=envmatte"
ZIP = {"Content-Type": "application/zip"}
VIDEO = {"Content-Type": "video/mp4"}


@pytest.fixture
def client(engine: Engine, build: Callable[..., FastAPI]) -> Callable[[bool], TestClient]:
    """The API with a matte; webhooks may go to private addresses, or not."""
    with writing(engine) as c:
        mattes.add_imported(c, "m", {}, {})
    return lambda private: TestClient(
        build(webhook_secret=16 * "s", webhook_private=private), "http://localhost"
    )


@pytest.fixture
def archive(tmp_path: Path) -> bytes:
    program = nested_program(bands=((8, 6, 16),), levels=2)
    write_capture(glass_ball.glass_ball(24, 16, rays=1), program, tmp_path / "ball.zip")
    return (tmp_path / "ball.zip").read_bytes()


def webhook_of(engine: Engine, job: str) -> str | None:
    with reading(engine) as c:
        return jobs.get(c, job).webhook


def test_captures_and_clips_take_a_webhook(
    engine: Engine, archive: bytes, client: Callable[[bool], TestClient]
) -> None:
    http = client(True)
    for query in ({"webhook": URL}, {}):
        capture = http.post("/v1/captures", content=archive, headers=ZIP, params=query)
        assert webhook_of(engine, capture.json()["job"]) == query.get("webhook")
        clip = http.post("/v1/mattes/m/composite", content=b"clip", headers=VIDEO, params=query)
        assert clip.status_code == 202
        assert webhook_of(engine, clip.json()["id"]) == query.get("webhook")
        assert clip.json()["options"].keys() == {"transfer", "around", "fit", "placement"}


def test_private_address_is_refused(
    archive: bytes, client: Callable[[bool], TestClient], tmp_path: Path
) -> None:
    http, query = client(False), {"webhook": URL.replace("http:", "https:")}
    for url, body, headers in (
        ("/v1/captures", archive, ZIP),
        ("/v1/mattes/m/composite", b"clip", VIDEO),
    ):
        answer = http.post(url, content=body, headers=headers, params=query)
        assert (answer.status_code, answer.json()["field"]) == (422, "webhook")
    answer = http.post("/v1/jobs", json={"capture": "c"} | query)
    assert (answer.status_code, answer.json()["field"]) == (422, "webhook")
    assert http.get("/v1/jobs").json() == {"jobs": []}
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []


def test_still_takes_no_webhook(client: Callable[[bool], TestClient]) -> None:
    answer = client(True).post("/v1/mattes/m/composite", content=b"picture", params={"webhook": URL})
    assert (answer.status_code, answer.json()["field"]) == (422, "webhook")
