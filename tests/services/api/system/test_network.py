"""The address for other devices, or what to do if there is none."""

from collections.abc import Callable

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import Engine

from storage.database.engine import writing
from storage.records import api_keys


@pytest.mark.parametrize("keys", ["no key", "a key of the settings", "a key of the database"])
def test_loopback_service_says_how_to_become_reachable(
    engine: Engine, build: Callable[..., FastAPI], keys: str
) -> None:
    key = "given"
    if keys == "a key of the database":
        with writing(engine) as c:
            key = api_keys.create(c, "lab", "alice", "read")
    app = build(keys="given" if keys == "a key of the settings" else ())
    http = TestClient(app, "http://localhost", headers={"Authorization": f"Bearer {key}"})
    answer = http.get("/v1/network").json()
    assert answer["url"] is None
    assert "127.0.0.1 only" in answer["problem"]
    assert "`envmatte serve --host 0.0.0.0`" in answer["problem"]
    assert ("envmatte keys make" in answer["problem"]) == (keys == "no key")
