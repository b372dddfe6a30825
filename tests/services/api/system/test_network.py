"""The address for other devices, or what to do if there is none."""

from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from services.api.app import build_app
from services.settings import Settings
from storage.database.engine import open_engine, writing
from storage.objects.store import Objects
from storage.records import api_keys


@pytest.mark.parametrize("keys", ["no key", "a key of the settings", "a key of the database"])
def test_loopback_service_says_how_to_become_reachable(tmp_path: Path, keys: str) -> None:
    engine = open_engine(f"sqlite:///{tmp_path}/ledger.db")
    settings = Settings(data=tmp_path, keys="given" if keys == "a key of the settings" else ())
    key = "given"
    if keys == "a key of the database":
        with writing(engine) as c:
            key = api_keys.create(c, "lab", "alice", "read")
    app = build_app(settings, engine, Objects((tmp_path / "store").as_uri()))
    answer = (
        TestClient(app, "http://localhost", headers={"Authorization": f"Bearer {key}"})
        .get("/v1/network")
        .json()
    )
    engine.dispose()
    assert answer["url"] is None
    assert "127.0.0.1 only" in answer["problem"]
    assert "`envmatte serve --host 0.0.0.0`" in answer["problem"]
    assert ("envmatte keys make" in answer["problem"]) == (keys == "no key")
