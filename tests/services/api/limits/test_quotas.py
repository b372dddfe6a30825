"""Limits: refused before any byte is stored, with the limit's name; the app with a real database and store."""

import base64
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import Engine, update

from services.api.app import build_app
from services.api.system.limits import UNITS
from services.settings import Settings
from storage.database.engine import open_engine, reading, writing
from storage.database.owners import for_owner
from storage.database.rows import PAUSE, ROW, json_bytes
from storage.database.tables import uploads
from storage.errors import FEW_FILES
from storage.objects.store import Objects
from storage.records import api_keys, captures, jobs, mattes, tiles
from storage.statistics import PART, PROMISE, TILE
from tests.parts.captures import nested_program
from tests.parts.disks import small_disk
from workflows.simulation import glass_ball
from workflows.simulation.scene import write_capture

Serve = Callable[..., TestClient]
TUS = {"Tus-Resumable": "1.0.0"}
ZIP = {"Content-Type": "application/zip"}


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("archive") / "ball.zip"
    write_capture(
        glass_ball.glass_ball(24, 16, rays=1), nested_program(bands=((8, 6, 16),), levels=2), path, name="b"
    )
    return path.read_bytes()


@pytest.fixture
def engine(database_url: str, tmp_path: Path) -> Iterator[Engine]:
    opened = open_engine(database_url)
    with writing(opened) as c:
        tmp_path.joinpath("alice").write_text(api_keys.create(c, "alice", "alice", "write"))
        tmp_path.joinpath("bob").write_text(api_keys.create(c, "bob", "bob", "admin"))
    yield opened
    opened.dispose()


@pytest.fixture
def serve(engine: Engine, tmp_path: Path) -> Serve:
    """Serves the API with some limits and without a coordinator, so that jobs stay queued."""

    def serve(owner: str = "alice", **limits: int) -> TestClient:
        app = build_app(Settings(data=tmp_path, **limits), engine, Objects((tmp_path / "store").as_uri()))
        key = tmp_path.joinpath(owner).read_text()
        return TestClient(app, headers={"Authorization": f"Bearer {key}"}, raise_server_exceptions=False)

    return serve


def files(tmp_path: Path) -> list[Path]:
    return [path for path in (tmp_path / "store").rglob("*") if path.is_file()]


def test_disk_that_takes_hardly_any_more_files(engine: Engine, tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 32 << 20, files=2000) as disk:
        app = build_app(Settings(data=tmp_path), engine, Objects((disk / "store").as_uri()))
        headers = {"Authorization": f"Bearer {tmp_path.joinpath('alice').read_text()}"}
        service = TestClient(app, headers=headers)
        empty = TUS | {"Upload-Length": "1"}
        assert service.post("/v1/uploads", headers=empty).status_code == 201
        for n in range(1960):
            (disk / str(n)).touch()
        answer = service.post("/v1/uploads", headers=empty)
        assert (answer.status_code, answer.json()["detail"]) == (507, FEW_FILES)
        found = service.get("/readyz")
        assert (found.status_code, found.json()["store"]) == (503, FEW_FILES)


def refused(answer: Any, status: int, name: str, limit: int, value: int) -> dict[str, Any]:
    problem: dict[str, Any] = answer.json()
    assert (answer.status_code, problem["name"], problem["limit"], problem["value"]) == (
        status,
        name,
        limit,
        value,
    )
    assert str(limit) in problem["detail"]
    return problem


def used(client: TestClient) -> dict[str, int | None]:
    return {
        limit["name"]: limit["used"]
        for limit in client.get("/v1/limits").json()["limits"]
        if limit["used"] is not None
    }


def create(client: TestClient, length: int) -> Any:
    return client.post("/v1/uploads", headers=TUS | {"Upload-Length": str(length)})


def rows_of(made: Any) -> int:
    """Bytes of the rows of a capture and of its job."""
    return 2 * ROW + json_bytes(made.json()["program"])


def test_all_limits_are_listed_with_their_usage(serve: Serve, archive: bytes) -> None:
    alice, bob = (
        serve(owner_captures=7, store_bytes=1 << 30),
        serve("bob", owner_captures=7, store_bytes=1 << 30),
    )
    assert used(alice) == {"owner_captures": 0, "owner_jobs": 0, "owner_bytes": 0}
    made = alice.post("/v1/captures", content=archive, headers=ZIP)
    assert made.status_code == 201
    assert create(alice, 1000).status_code == 201
    size = len(archive) + 1000 + rows_of(made) + ROW
    assert used(alice) == {"owner_captures": 2, "owner_jobs": 1, "owner_bytes": size}
    assert used(bob) == {"owner_captures": 0, "owner_jobs": 0, "owner_bytes": 0, "store_bytes": size}
    listed = alice.get("/v1/limits").json()
    assert (listed["owner"], listed["scope"]) == ("alice", "write")
    found = {limit["name"]: limit["limit"] for limit in listed["limits"]}
    assert found.keys() == UNITS.keys()
    assert (found["upload_bytes"], found["owner_captures"], found["owner_jobs"]) == (8 << 30, 7, None)
    assert all(limit["description"] for limit in listed["limits"])


def test_bytes_of_an_upload(serve: Serve, archive: bytes, tmp_path: Path) -> None:
    client = serve(upload_bytes=100)
    refused(create(client, 101), 413, "upload_bytes", 100, 101)
    assert create(client, 100).status_code == 201
    for url in ("/v1/captures", "/v1/mattes"):
        for content in (archive, iter([archive])):  # the second without Content-Length
            refused(client.post(url, content=content, headers=ZIP), 413, "upload_bytes", 100, len(archive))
    assert files(tmp_path) == []


def test_captures_of_an_owner(serve: Serve, archive: bytes, tmp_path: Path) -> None:
    client, bob = serve(owner_captures=2), serve("bob", owner_captures=2)
    capture = client.post("/v1/captures", content=archive, headers=ZIP).json()
    assert create(client, 10).status_code == 201
    before = files(tmp_path)
    detail = refused(create(client, 10), 507, "owner_captures", 2, 3)["detail"]
    assert "this would be number 3; delete some first" in detail
    refused(client.post("/v1/captures", content=archive, headers=ZIP), 507, "owner_captures", 2, 3)
    assert files(tmp_path) == before
    assert bob.post("/v1/captures", content=archive, headers=ZIP).status_code == 201
    client.post(f"/v1/jobs/{capture['job']}/cancel")
    assert client.delete(f"/v1/captures/{capture['id']}").status_code == 204
    assert client.post("/v1/captures", content=archive, headers=ZIP).status_code == 201


def test_unfinished_upload_counts_as_a_capture(serve: Serve, archive: bytes) -> None:
    client = serve(owner_captures=1, owner_bytes=len(archive) + ROW)
    where = create(client, len(archive)).headers["location"]
    chunk = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    assert client.patch(where, content=archive, headers=chunk).status_code == 204
    body = {"upload": where.rsplit("/", 1)[1]}
    assert client.post("/v1/captures", json=body).status_code == 201
    assert used(client)["owner_captures"] == 1


def test_jobs_of_an_owner(serve: Serve, archive: bytes, engine: Engine) -> None:
    client, bob = serve(owner_jobs=2), serve("bob", owner_jobs=2)
    capture = client.post("/v1/captures", content=archive, headers=ZIP).json()
    wanted = {"capture": capture["id"]}
    job = client.post("/v1/jobs", json=wanted).json()["id"]
    answer = client.post("/v1/jobs", json=wanted)
    refused(answer, 429, "owner_jobs", 2, 3)
    assert int(answer.headers["retry-after"]) > 0
    refused(client.post("/v1/captures", content=archive, headers=ZIP), 429, "owner_jobs", 2, 3)
    where = create(client, len(archive)).headers["location"]
    chunk = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    assert client.patch(where, content=archive, headers=chunk).status_code == 204
    body = {"upload": where.rsplit("/", 1)[1]}
    refused(client.post("/v1/captures", json=body), 429, "owner_jobs", 2, 3)
    assert client.head(where, headers=TUS).status_code == 200  # it may become one later
    with writing(for_owner(engine, "alice")) as c:
        mattes.add_imported(c, "m", {}, {})
    video = {"Content-Type": "video/mp4"}
    refused(client.post("/v1/mattes/m/composite", content=b"clip", headers=video), 429, "owner_jobs", 2, 3)
    with writing(engine) as c:
        jobs.end(c, job, "failed", {"detail": "", "status": 500})
    assert bob.post("/v1/captures", content=archive, headers=ZIP).status_code == 201
    assert client.post("/v1/jobs", json=wanted).status_code == 202
    refused(client.post(f"/v1/jobs/{job}/retry"), 429, "owner_jobs", 2, 3)
    clip = serve().post("/v1/mattes/m/composite", content=b"clip", headers=video)
    assert (clip.status_code, clip.json()["capture"], clip.json()["matte"]) == (202, None, "m")
    with reading(engine) as c:
        assert jobs.get(c, job).state == "failed"


@pytest.mark.parametrize(("name", "others"), [("owner_bytes", False), ("store_bytes", True)])
def test_bytes_stored(serve: Serve, archive: bytes, tmp_path: Path, name: str, others: bool) -> None:
    size = len(archive)
    made = serve().post("/v1/captures", content=archive, headers=ZIP)
    capture, most = made.json()["id"], 2 * size + rows_of(made)
    alice, bob = serve(**{name: most}), serve("bob", **{name: most})
    assert create(bob, size).status_code == 201
    before = files(tmp_path)
    problem = create(alice, size + 1).json()
    assert (problem["status"], problem["name"], problem["limit"]) == (507, name, most)
    room = size - ROW  # of which bob was promised all, and keeps half
    assert problem["missing"] == (size + 1 - (room - room // 2) if others else 1)

    def pieces() -> Iterator[bytes]:
        yield archive  # without announced length: it is refused once it has come

    answers = [alice.post("/v1/captures", content=content, headers=ZIP) for content in (archive, pieces())]
    assert [answer.status_code for answer in answers] == [507 if others else 201, 507]
    if others:
        assert files(tmp_path) == before
        problem = alice.post("/v1/mattes", content=archive, headers=ZIP).json()
        assert (problem["status"], problem["name"]) == (507, name)
        assert str(3 * size) not in problem["detail"]  # does not reveal what bob has
    assert alice.get(f"/v1/captures/{capture}").status_code == 200


def test_body_without_a_length_takes_what_room_there_is(serve: Serve, archive: bytes) -> None:
    made = serve().post("/v1/captures", content=archive, headers=ZIP)
    client = serve(owner_bytes=2 * (len(archive) + rows_of(made)))  # far less than a whole step more
    assert client.post("/v1/captures", content=iter([archive]), headers=ZIP).status_code == 201
    assert create(client, 1).status_code == 507


def test_promises_of_others_keep_at_most_half_and_decay(serve: Serve, engine: Engine) -> None:
    limit = 1_000_000
    alice, bob = (serve(owner, store_bytes=limit) for owner in ("alice", "bob"))
    promised = [create(bob, 200_000).headers["location"] for _ in range(4)]
    problem = refused(create(alice, 600_000), 507, "store_bytes", limit, 600_000)
    assert problem["missing"] == 600_000 - (limit - 4 * ROW) // 2
    assert "800000" not in str(problem)  # what bob was promised
    mine = create(alice, 400_000).headers["location"]
    chunk = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    assert alice.patch(mine, content=bytes(400_000), headers=chunk).status_code == 204
    answers = [bob.patch(one, content=bytes(200_000), headers=chunk) for one in promised]
    assert [answer.status_code for answer in answers] == [204, 204, 507, 507]  # promised twice
    assert alice.delete(mine, headers=TUS).status_code == 204
    most = limit - 4 * ROW - 2 * (200_000 + PART)
    assert create(alice, most).status_code == 507
    with writing(engine) as c:
        c.execute(update(uploads).values(moved_at=time.time() - PROMISE - 1))
    assert create(alice, most).status_code == 201


@pytest.mark.parametrize(("name", "others"), [("owner_bytes", False), ("store_bytes", True)])
def test_bytes_of_programs(serve: Serve, name: str, others: bool) -> None:
    def body(seed: int) -> dict[str, Any]:
        parts = [
            {"kind": "constant", "levels": [0, 1]},
            {"kind": "bernoulli", "columns": 2, "rows": 2, "count": 5, "seed": seed},
        ]
        return {"program": {"monitor": {"width": 8, "height": 8}, "parts": parts}}

    bob = serve("bob")
    kept = [bob.post("/v1/programs", json=body(seed)).json()["program"] for seed in (1, 2)]
    sizes = [len(json.dumps(program)) for program in kept]
    assert used(bob) == {
        "owner_captures": 0,
        "owner_jobs": 0,
        "owner_bytes": sum(sizes),
        "store_bytes": sum(sizes),
    }
    most = (4 if others else 2) * sizes[0]
    alice = serve(**{name: most})
    first, second = (alice.post("/v1/programs", json=body(seed)) for seed in (1, 2))
    assert (first.status_code, second.status_code) == (201, 201)
    assert used(alice)["owner_bytes"] == sum(sizes)
    problem = alice.post("/v1/programs", json=body(3)).json()
    assert (problem["status"], problem["name"], problem["limit"]) == (507, name, most)
    assert problem["missing"] == sizes[0]
    assert create(alice, 1).status_code == 507
    assert [one["id"] for one in alice.get("/v1/programs").json()["programs"]] == [
        answer.json()["id"] for answer in (second, first)
    ]
    assert alice.post("/v1/programs", json=body(1)).json() == first.json()  # a repeat takes no room
    assert alice.delete(f"/v1/programs/{first.json()['id']}").status_code == 204
    assert alice.post("/v1/programs", json=body(3)).status_code == 201


def test_rows_count_as_stored(serve: Serve, archive: bytes, engine: Engine) -> None:
    client = serve()
    made = client.post("/v1/captures", content=archive, headers=ZIP)
    plan = {"tiles": 50, "notes": ["n" * 10_000]}
    with writing(engine) as c:
        tiles.add_plan(c, made.json()["job"], plan)
        jobs.end(c, made.json()["job"], "failed", {"detail": "", "status": 422})
        captures.change(c, made.json()["id"], state="failed", stored=0)
    of_plan = json_bytes(plan) + 50 * TILE
    assert used(client)["owner_bytes"] == rows_of(made) + of_plan
    assert client.delete(f"/v1/captures/{made.json()['id']}").status_code == 204
    assert used(client)["owner_bytes"] == ROW + of_plan
    assert create(serve(owner_bytes=10_000), 1).status_code == 507
    assert client.delete(f"/v1/jobs/{made.json()['job']}").status_code == 204
    assert used(client)["owner_bytes"] == 0


def test_pauses_count_as_stored(serve: Serve, archive: bytes, engine: Engine) -> None:
    made = serve().post("/v1/captures", content=archive, headers=ZIP)
    job, before = made.json()["job"], len(archive) + rows_of(made)
    client = serve(owner_bytes=before + PAUSE)

    def pause(paused: bool) -> Any:
        return client.patch(f"/v1/jobs/{job}", json={"paused": paused})

    answers = [pause(paused).status_code for paused in (True, True, False, True, True, False)]
    assert answers == [200] * 6
    assert used(client)["owner_bytes"] == before + 2 * PAUSE
    refused(pause(True), 507, "owner_bytes", before + PAUSE, before + 2 * PAUSE)
    plan = {"tiles": 5, "memory": 1}
    with writing(engine) as c:
        tiles.add_plan(c, job, plan)
    assert used(client)["owner_bytes"] == before + 2 * PAUSE + json_bytes(plan) + 5 * TILE
    with writing(engine) as c:
        jobs.end(c, job, "failed", {"detail": "", "status": 500})
        jobs.retry(c, job, replan=True)
    assert used(client)["owner_bytes"] == before + 2 * PAUSE + ROW


def test_frames_of_a_capture(serve: Serve, archive: bytes, tmp_path: Path) -> None:
    client = serve(capture_frames=17)
    refused(client.post("/v1/captures", content=archive, headers=ZIP), 413, "capture_frames", 17, 18)
    where = create(client, len(archive)).headers["location"]
    chunk = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    client.patch(where, content=archive, headers=chunk)
    body = {"upload": where.rsplit("/", 1)[1]}
    refused(client.post("/v1/captures", json=body), 413, "capture_frames", 17, 18)
    assert files(tmp_path) == []  # it would be refused again
    assert used(client)["owner_captures"] == 0
    assert serve(capture_frames=18).post("/v1/captures", content=archive, headers=ZIP).status_code == 201


def test_declared_frames_are_checked_before_the_upload(serve: Serve, tmp_path: Path) -> None:
    client = serve(capture_frames=17, capture_pixels=384)

    def declaring(**declared: object) -> Any:
        pairs = (
            f"{name} {base64.b64encode(str(value).encode()).decode()}" for name, value in declared.items()
        )
        return client.post(
            "/v1/uploads", headers=TUS | {"Upload-Length": "10", "Upload-Metadata": ", ".join(pairs)}
        )

    refused(declaring(frames=18), 413, "capture_frames", 17, 18)
    refused(declaring(filename="a.zip", width=25, height=16), 413, "capture_pixels", 384, 400)
    for wrong in ("many", "", "-1", "9" * 19, "٣"):
        answer = declaring(frames=wrong)
        assert (answer.status_code, answer.json()["field"]) == (400, "Upload-Metadata")
    assert files(tmp_path) == []
    assert used(client)["owner_captures"] == 0
    for fine in ({"frames": 17, "width": 24, "height": 16}, {"width": 9999}, {"frame": 99}):
        assert declaring(**fine).status_code == 201


def test_expiry_is_in_the_answers(serve: Serve, archive: bytes, engine: Engine) -> None:
    client = serve(capture_seconds=60, matte_seconds=3600)
    capture = client.post("/v1/captures", content=archive, headers=ZIP).json()
    matte = client.post("/v1/jobs", json={"capture": capture["id"]}).json()["matte"]
    with reading(engine) as c:
        for seconds, row in ((60, captures.get(c, capture["id"])), (3600, mattes.get(c, matte))):
            assert row.expires_at - row.created_at == pytest.approx(seconds)
    for url in (f"/v1/captures/{capture['id']}", f"/v1/mattes/{matte}"):
        found = client.get(url).json()
        assert found["expires_at"].endswith("Z")
        assert found["expires_at"] > found["created_at"]
    forever = serve().post("/v1/captures", content=archive, headers=ZIP).json()
    assert forever["expires_at"] is None
