"""Mattes are exported from one service and imported by another."""

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import httpx2
import numpy as np
import pytest

from services.client import ServiceError
from storage.layout import mattes
from storage.layout.matte_archive import MANIFEST, Archive
from storage.layout.mattes import empty_block
from storage.objects.store import Objects
from tests.end_to_end.command_line import envmatte
from tests.end_to_end.conftest import Service, digests, png, serving
from tests.end_to_end.problems import check_problem
from tests.parts.waiting import until
from workflows.simulation import glass_ball

ZIP = {"Content-Type": "application/zip"}


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Another service with its own data."""
    with serving(tmp_path_factory.mktemp("elsewhere") / "data", "--workers", "1") as running:
        yield running


@pytest.fixture(scope="module")
def archive(service: Service, matte: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene's matte, exported."""
    path = tmp_path_factory.mktemp("archive") / "matte.zip"
    service.client.export(matte, path)
    return path


@pytest.mark.slow
def test_archive_restores_the_matte_in_another_service(
    service: Service, elsewhere: Service, matte: str, tmp_path: Path
) -> None:
    path = tmp_path / "matte.zip"
    exported = envmatte(service, "export", matte, "-o", str(path))
    assert (exported.returncode, exported.stdout.strip()) == (0, str(path)), exported.stderr
    assert "export: 100%" in exported.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["matte.zip"]

    imported = envmatte(elsewhere, "import", str(path))
    assert imported.returncode == 0, imported.stderr
    assert "import: 100%" in imported.stderr
    imported_id = imported.stdout.strip()
    store = Path("store/mattes")
    assert digests(elsewhere.data / store / imported_id) == digests(service.data / store / matte)

    backdrop = png(glass_ball.backdrop(160, 120), "srgb", "uint8")
    assert elsewhere.client.composite(imported_id, backdrop) == service.client.composite(matte, backdrop)
    before, after = service.client.matte(matte), elsewhere.client.matte(imported_id)
    assert (after["state"], after["capture"], after["job"]) == ("ready", None, None)
    for name in ("width", "height", "monitor", "columns", "rows"):
        assert after[name] == before[name]
    assert after["options"].items() <= before["options"].items()
    assert after["id"] in [m["id"] for m in elsewhere.http.get("/v1/mattes").json()["mattes"]]

    elsewhere.client.export(imported_id, tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == path.read_bytes()
    assert elsewhere.http.delete(f"/v1/mattes/{imported_id}").status_code == 204
    assert elsewhere.stored() == set()


def test_archive_has_a_name_and_a_size(service: Service, matte: str, archive: Path) -> None:
    answer = service.http.get(f"/v1/mattes/{matte}/archive")
    assert answer.content == archive.read_bytes()
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-length"] == str(archive.stat().st_size)
    for title, name in (("Glas „1“", "Glas_1_"), ("Größe", "Gr%C3%B6%C3%9Fe"), ("a ball", "a_ball")):
        service.http.patch(f"/v1/mattes/{matte}", json={"name": title})
        answer = service.http.get(f"/v1/mattes/{matte}/archive")
        disposition = f"attachment; filename=\"matte-{matte}.zip\"; filename*=UTF-8''{name}.zip"
        assert answer.headers["content-disposition"] == disposition
    check_problem(service.http.get("/v1/mattes/none/archive"), 404, "not-found")


@pytest.mark.slow
def test_same_idempotency_key_imports_once(elsewhere: Service, archive: Path) -> None:
    headers = ZIP | {"Idempotency-Key": "once"}
    first, again = (
        elsewhere.http.post("/v1/mattes", content=archive.read_bytes(), headers=headers) for _ in range(2)
    )
    assert (first.status_code, again.status_code) == (201, 201)
    made = first.json()["id"]
    assert again.json()["id"] == made
    assert first.headers["location"] == again.headers["location"] == f"/v1/mattes/{made}"
    other = elsewhere.client.import_matte(archive)["id"]
    assert other != made
    for id in (made, other):
        elsewhere.http.delete(f"/v1/mattes/{id}")
    assert elsewhere.stored() == set()


@pytest.mark.slow
def test_false_archive_is_refused_and_leaves_nothing(
    elsewhere: Service, archive: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(archive) as file:
        files = {name: file.read(name) for name in file.namelist()}
    damaged = io.BytesIO()
    with zipfile.ZipFile(damaged, "w") as file:
        for name, data in files.items():
            file.writestr(name, data if name != "rho/c/0/0/0" else data[::-1])
    listed = elsewhere.http.get("/v1/mattes").json()
    for body, entry in (
        (damaged.getvalue(), "rho/c/0/0/0"),
        (archive.read_bytes()[:-1000], None),
        (b"", None),
    ):
        answer = elsewhere.http.post("/v1/mattes", content=body, headers=ZIP)
        assert check_problem(answer, 422, "bad-archive").get("entry") == entry
    answer = elsewhere.http.post("/v1/mattes", content=b"{}", headers={"Content-Type": "application/json"})
    check_problem(answer, 415, "wrong-media-type")
    (tmp_path / "damaged.zip").write_bytes(damaged.getvalue())
    refused = envmatte(elsewhere, "import", str(tmp_path / "damaged.zip"))
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "rho/c/0/0/0" in refused.stderr
    assert elsewhere.http.get("/v1/mattes").json() == listed
    assert elsewhere.stored() == set()


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A matte whose archive has 22 MB, more than fits into the buffers of a connection."""
    folder = tmp_path_factory.mktemp("large")
    objects = Objects((folder / "store").as_uri())
    attributes = {"monitor": [8, 6], "crosstalk": np.eye(3).tolist(), "options": {}}
    matte = mattes.create(objects, "m", height=768, width=1024, columns=4, rows=3, **attributes)
    rng = np.random.default_rng(0)
    black = empty_block(64, 64)
    for row, column in product(range(matte.block_rows), range(matte.block_columns)):
        S, rho = rng.random((2, 64, 64, 3), np.float32)
        error = rng.random((64, 64), np.float32)
        block = replace(black, S=S, rho=rho, error=error, recovered=~black.recovered)
        matte.write(row, column, block)
    (folder / "matte.zip").write_bytes(b"".join(Archive(objects, "m")))
    return folder / "matte.zip"


@pytest.mark.exhaustive
@pytest.mark.slow
def test_deleting_a_matte_ends_its_download(elsewhere: Service, large: Path, tmp_path: Path) -> None:
    imported_id = elsewhere.client.import_matte(large)["id"]
    logged = elsewhere.log()
    sent: list[bytes] = []
    with elsewhere.http.stream("GET", f"/v1/mattes/{imported_id}/archive") as answer:
        assert elsewhere.http.delete(f"/v1/mattes/{imported_id}").status_code == 204
        with pytest.raises(httpx2.RemoteProtocolError):
            sent.extend(answer.iter_bytes())
    assert not zipfile.is_zipfile(io.BytesIO(b"".join(sent)))
    until(lambda: f"ended the download of matte {imported_id}" in elsewhere.log())
    assert " ERROR " not in elsewhere.log().removeprefix(logged)
    with pytest.raises(ServiceError, match=imported_id):
        elsewhere.client.export(imported_id, tmp_path / "matte.zip")
    assert list(tmp_path.iterdir()) == []
    assert elsewhere.stored() == set()


@pytest.mark.exhaustive
def test_killed_service_keeps_only_complete_imports(archive: Path, tmp_path: Path) -> None:
    with serving(tmp_path / "data", "--workers", "1") as first:
        whole = first.client.import_matte(archive)["id"]
        kept = first.stored()
        half = first.data / "store/mattes/half/S/c/0/0/0"  # written by an import that was killed
        half.parent.mkdir(parents=True)
        half.write_bytes(b"x")
        (first.data / "store/uploads/half").mkdir(parents=True)
        (first.data / "store/uploads/half/all.part").write_bytes(b"x")
        first.kill()
    with serving(tmp_path / "data", "--workers", "1") as second:
        until(lambda: second.stored() == kept)
        assert second.client.matte(whole)["state"] == "ready"
        manifest = json.loads(zipfile.ZipFile(archive).read(MANIFEST))
        assert second.client.matte(whole)["options"] == manifest["matte"]["options"]
