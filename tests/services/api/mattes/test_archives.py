"""Archives of mattes while something else happens, as a restart of the database, and one that is too large."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import event

from services.api.app import build_app
from services.settings import Settings
from storage.database.engine import open_engine
from storage.layout.matte_archive import Archive
from storage.layout.mattes import Matte
from storage.objects.store import Objects
from tests.parts.postgres import Server
from tests.services.api.mattes.archives import archive

ZIP = {"Content-Type": "application/zip"}


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["unpacking", "writing its row"])
def test_import_goes_on_although_the_database_restarts(
    postgresql: str, postgresql_server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    engine, objects = open_engine(postgresql), Objects((tmp_path / "store").as_uri())
    restarts: list[str] = []

    def restart() -> None:
        if not restarts:
            restarts.append(moment)
            postgresql_server.restart()

    if moment == "unpacking":
        write = Matte.write
        monkeypatch.setattr(Matte, "write", lambda *block: (restart(), write(*block)))
    else:

        @event.listens_for(engine, "after_cursor_execute")
        def executed(connection: Any, cursor: Any, sql: str, *more: Any) -> None:
            if sql.startswith("INSERT INTO mattes"):
                restart()

    sent = archive(tmp_path / "made", 300, 200)
    app = build_app(Settings(data=tmp_path), engine, objects)
    with TestClient(app, "http://127.0.0.1") as client:
        answer = client.post("/v1/mattes", content=sent, headers=ZIP)
        assert (answer.status_code, restarts) == (201, [moment]), answer.text
        made = answer.json()["id"]
        assert [one["id"] for one in client.get("/v1/mattes").json()["mattes"]] == [made]
        assert client.get(f"/v1/mattes/{made}/archive").content == sent
    assert set(objects.names("mattes")) - {"zarr.json"} == {made}
    assert objects.names("uploads") == []
    app.state.context.decoders.close()
    engine.dispose()


def test_download_of_a_matte_that_is_deleted_ends_with_a_line_in_the_log(
    build: Callable[..., FastAPI],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with TestClient(build(), "http://127.0.0.1") as client:
        where = (
            "/v1/mattes/"
            + client.post("/v1/mattes", content=archive(tmp_path / "made", 100, 80), headers=ZIP).json()["id"]
        )
        read = Archive._read
        monkeypatch.setattr(
            Archive, "_read", lambda self, names: (client.delete(where), read(self, names))[1]
        )
        with caplog.at_level("INFO", "services"):
            answer = client.get(f"{where}/archive")
    assert (answer.status_code, len(answer.content) < int(answer.headers["content-length"])) == (200, True)
    (line,) = [record for record in caplog.records if record.name.startswith("services.api")]
    assert (line.levelname, "there is no matte" in line.getMessage()) == ("INFO", True)


def test_archive_that_unpacks_to_too_much_is_refused_by_the_setting(
    build: Callable[..., FastAPI], tmp_path: Path
) -> None:
    with TestClient(build(unpacked_bytes=100_000), "http://localhost") as client:
        answer = client.post("/v1/mattes", content=archive(tmp_path / "other", 64, 64), headers=ZIP)
    assert (answer.status_code, answer.json()["limit"]) == (422, 100_000)
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []
