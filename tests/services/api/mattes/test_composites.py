"""Composites on a real port: an owner has a share of what waits on disk, and broken uploads leave nothing."""

import io
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import numpy as np
import OpenEXR
import pytest
import uvicorn
from sqlalchemy import Engine

from services.api.app import BACKDROPS, build_app
from services.api.mattes import layers
from services.api.mattes.composites import composites
from services.settings import Settings
from storage.database.engine import writing
from storage.database.owners import for_owner
from storage.objects.store import Objects
from storage.records import api_keys, mattes
from tests.parts.inputs.hostile_mattes import large_matte
from tests.parts.waiting import until
from workflows.composite.live.nodes.exr import bytes_of_lookups
from workflows.images.integer_formats import encode_png
from workflows.mattes.layers import bytes_of_everything

LIMIT = 2 << 20
"""Bytes of a backdrop."""
SENT = 3 << 19
"""Bytes of each that come: more than are kept in memory."""
BACKDROP = encode_png(np.zeros((8, 8, 3), np.uint8))


@dataclass
class Api:
    url: str
    keys: dict[str, str]

    def composite(
        self, owner: str, seconds: float = 120, body: bytes = BACKDROP, **headers: str
    ) -> httpx2.Response:
        headers["Authorization"] = f"Bearer {self.keys[owner]}"
        url = f"{self.url}/v1/mattes/{owner}/composite"
        return httpx2.post(url, content=body, headers=headers, timeout=seconds)

    def begin(self, owner: str) -> socket.socket:
        """Begin a composite with a backdrop of unknown length that does not end."""
        where = urlsplit(self.url)
        connection = socket.create_connection((where.hostname or "", where.port or 0))
        head = (
            f"POST /v1/mattes/{owner}/composite HTTP/1.1\r\nHost: {where.netloc}\r\n"
            f"Authorization: Bearer {self.keys[owner]}\r\nTransfer-Encoding: chunked\r\n\r\n{LIMIT:x}\r\n"
        )
        connection.sendall(head.encode() + bytes(SENT))
        return connection


@pytest.fixture
def api(tmp_path: Path, engine: Engine, objects: Objects) -> Iterator[Api]:
    with writing(engine) as c:
        keys = {owner: api_keys.create(c, owner, owner, "write") for owner in ("alice", "bob")}
    for owner in keys:
        made = large_matte(tmp_path / "store", owner, 64)
        with writing(for_owner(engine, owner)) as c:
            mattes.add_imported(c, owner, {"method": "lobes"}, made.figures)
    app = build_app(Settings(data=tmp_path, backdrop_bytes=LIMIT), engine, objects)
    config = uvicorn.Config(app, port=0, log_config=None, lifespan="off", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    with config.bind_socket() as bound:
        bound.listen()
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        yield Api(f"http://127.0.0.1:{bound.getsockname()[1]}", keys)
        server.should_exit = True
        thread.join()
    app.state.context.decoders.close()


def spooled() -> int:
    """Bytes of the temporary files without a name that this process has open."""
    size = 0
    for file in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # it has been closed
            if str(file.readlink()).endswith("(deleted)"):
                size += file.stat().st_size
    return size


@pytest.mark.slow
def test_backdrops_of_one_owner_keep_no_other_waiting_and_leave_nothing(api: Api) -> None:
    before, share = spooled(), BACKDROPS // 2
    sending = [api.begin("alice") for _ in range(share)]
    until(lambda: spooled() - before >= share * SENT)
    assert api.composite("bob").status_code == 200
    with pytest.raises(httpx2.ReadTimeout):
        api.composite("alice", seconds=1)
    for one in sending:
        one.close()
    assert api.composite("alice").status_code == 200
    until(lambda: spooled() == before)


def test_idempotency_key_that_is_too_long_is_refused(api: Api) -> None:
    """And not cut: two clips whose keys begin alike would get one job."""
    clip = {"body": b"any", "Content-Type": "video/mp4"}
    answer = api.composite("alice", **clip, **{"Idempotency-Key": "k" * 257})
    assert answer.status_code == 422
    assert answer.json()["field"] == "Idempotency-Key"
    assert api.composite("alice", **clip, **{"Idempotency-Key": "k" * 256}).status_code == 202


def test_video_sent_as_a_picture_is_refused_with_its_media_type(api: Api) -> None:
    clip = b"\0\0\0\x18ftypisom" + bytes(300)
    for headers in ({}, {"Content-Type": "application/x-www-form-urlencoded"}):
        answer = api.composite("alice", body=clip, **headers)
        assert answer.status_code == 415
        assert "`Content-Type: video/mp4`" in answer.json()["detail"]
    assert api.composite("alice", body=b"neither").status_code == 422


def test_picture_in_a_form_is_refused(api: Api) -> None:
    headers = {"Authorization": f"Bearer {api.keys['alice']}"}
    url = f"{api.url}/v1/mattes/alice/composite"
    answer = httpx2.post(url, files={"file": BACKDROP}, headers=headers, timeout=120)
    assert answer.status_code == 415
    assert "not in a form" in answer.json()["detail"]


def test_large_frames_have_as_many_lobes_and_lookups_as_fit(
    api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    def get(file: str, **query: int) -> httpx2.Response:
        url = f"{api.url}/v1/mattes/alice/layers/{file}"
        headers = {"Authorization": f"Bearer {api.keys['alice']}"}
        return httpx2.get(url, params=query, headers=headers, timeout=120)

    def weights(file: str) -> int:
        with OpenEXR.File(io.BytesIO(get(file).content), separate_channels=True) as held:
            return sum(
                name.startswith(("weight", "lobe")) and name.endswith(".R") for name in held.channels()
            )

    monkeypatch.setattr(layers, "MOST_BYTES", bytes_of_lookups(64, 64, 5))
    assert weights("lookups.exr") == 5
    assert "'lookups': 5" in get("blender.py").text
    assert get("blender.py", lookups=6).json()["field"] == "lookups"
    monkeypatch.setattr(layers, "MOST_BYTES", bytes_of_everything(64, 64, 3))
    assert weights("all.exr") == 3
    assert get("all.exr", lobes=4).json()["field"] == "lobes"
    monkeypatch.setattr(layers, "MOST_BYTES", 1)
    assert get("all.exr").json()["limit"] == 1
    assert get("matte.live").status_code == get("envmatte.js").status_code == 200


def test_upgrade_changes_the_tags_of_composites_and_layers(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    def tags() -> list[str]:
        known = {"Authorization": f"Bearer {api.keys['alice']}", "If-None-Match": "*"}
        layer = httpx2.get(f"{api.url}/v1/mattes/alice/layers/envmatte.js", headers=known)
        composite = api.composite("alice", **known)
        assert (layer.status_code, composite.status_code) == (304, 412)
        return [layer.headers["etag"], composite.headers["etag"]]

    before = tags()
    assert tags() == before
    for module in (layers, composites):
        monkeypatch.setattr(module, "VERSION", "99.0")
    assert all(new != old for new, old in zip(tags(), before, strict=True))
